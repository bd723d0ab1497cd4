"""Whether an attack's gradient points the right way: one step along it must lower the scores on the target."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from skyproof.attacks.attack import make_optimiser
from skyproof.attacks.objective import balanced_weights, empty_truth_losses, frozen
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.render.frames import Frames

__all__ = ["sign_test", "target_scores"]

_NEAR_M = 1.0


def sign_test(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: AttackWorld,
    settings: AttackSettings,
) -> dict[str, dict[str, Any]]:
    """One step of the attack's own optimiser on a batch, and what it does to the scores on that batch's vehicles.

    Every batch (those that no step of the attack sees) starts from the camouflage as given, which is not changed. The
    losses are balanced as at the start of an attack.

    Args:
        camouflage: as at the start of its attack.
        settings: batch size, learning rate, seed and number of batches (`balance_batches`).

    Returns:
        Per detector: "scenes" with a vehicle, in how many of them the score "fell", the one-sided exact "p" of so many
        if it were chance (binomial; scenes in which nothing changed count as not fallen), and the "mean_change".
    """
    before: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    after: dict[str, list[Tensor]] = {detector.name: [] for detector in detectors}
    with frozen(detectors):
        for batch in range(settings.balance_batches):
            scenes = world.step_scenes(settings.batch_size, settings.seed, -batch)
            moved = copy.deepcopy(camouflage)
            moved.before_step_(1, settings.steps)
            frames = world.frames(moved, scenes)
            losses = {
                name: values.mean()
                for name, values in empty_truth_losses(detectors, frames.image).items()
            }
            weights = balanced_weights(
                {name: [float(value.detach())] for name, value in losses.items()}
            )
            optimiser = make_optimiser(moved, settings)
            torch.stack([weights[name] * value for name, value in losses.items()]).sum().backward()
            optimiser.step()
            moved.project_()
            with torch.no_grad():
                stepped = world.frames(moved, scenes)
                for detector in detectors:
                    before[detector.name].append(
                        target_scores(detector, frames, world.backgrounds.gsd_m)
                    )
                    after[detector.name].append(
                        target_scores(detector, stepped, world.backgrounds.gsd_m)
                    )
    return {name: _judged(torch.cat(before[name]), torch.cat(after[name])) for name in before}


@torch.no_grad()
def target_scores(detector: TrainableDetector, frames: Frames, gsd_m: float) -> Float[Tensor, " B"]:
    """The highest score of a candidate whose centre lies within 1 m of the image's one vehicle; 0 without one."""
    found = detector.candidates(frames.image.detach())
    centres = (frames.boxes[:, :2] + frames.boxes[:, 2:]) / 2
    distance_m = ((found.boxes[..., :2] + found.boxes[..., 2:]) / 2 - centres[:, None]).norm(
        dim=-1
    ) * gsd_m
    near = found.valid & (distance_m <= _NEAR_M)
    return found.scores.masked_fill(~near, 0.0).amax(1)


def _judged(before: Tensor, after: Tensor) -> dict[str, Any]:
    scenes, fell = len(before), int((after < before).sum())
    return {
        "scenes": scenes,
        "fell": fell,
        "p": float(stats.binomtest(fell, scenes, 0.5, alternative="greater").pvalue),
        "mean_change": float((after - before).mean()),
    }
