"""The sign test of an attack's gradient: a step must lower the target's scores."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from scipy import special
from torch import Tensor

from skyproof.attacks.attack import attack_weights, descend, make_optimiser
from skyproof.attacks.objective import frozen, objective_and_gradient, target_scores
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.errors import NotFiniteError


def sign_test(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
) -> dict[str, dict[str, Any]]:
    """Takes one step of the attack's own optimiser, and compares the scores on the step's vehicles.

    Every one of the `balance_batches` starts from the given camouflage, which is not changed, on
    scenes that no step of the attack sees. "p" is the one-sided exact chance of so many fallen
    scores (binomial; unchanged scores have not fallen).
    """
    before: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    after: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    gsd_m = world.backgrounds.gsd_m
    with frozen(detectors):
        weights = attack_weights(detectors, world, settings)
        for batch in range(settings.balance_batches):
            scenes = world.step_scenes(settings.batch_size, settings.seed, -batch)
            moved = copy.deepcopy(camouflage)
            moved.before_step_(1, settings.steps)
            frames = world.frames(moved, scenes)
            _, gradient = objective_and_gradient(detectors, weights, frames.image)
            descend(moved, make_optimiser(moved, settings), frames.image, gradient)
            with torch.no_grad():
                stepped = world.frames(moved, scenes)
            for detector in detectors:
                before[detector.name].append(target_scores(detector, frames, gsd_m))
                after[detector.name].append(target_scores(detector, stepped, gsd_m))
    for name, scores in (*before.items(), *after.items()):
        if not bool(torch.cat(scores).isfinite().all()):
            raise NotFiniteError(
                f"The scores of the detector {name} are not finite on the attack's scenes; train "
                "or import it again, or attack with a lower learning rate."
            )
    return {name: _compared(torch.cat(before[name]), torch.cat(after[name])) for name in before}


def _compared(before: Tensor, after: Tensor) -> dict[str, Any]:
    fell = int((after < before).sum())
    return {
        "scenes": len(before),
        "fell": fell,
        # The binomial tail as scipy.stats has it, whose import takes as long as some steps.
        "p": float(special.bdtrc(fell - 1, len(before), 0.5)),
        "mean_change": float((after - before).mean()),
    }
