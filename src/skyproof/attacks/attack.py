"""The optimisation: random scenes, a camouflage, an ensemble of frozen detectors (section 3.2)."""

from __future__ import annotations

import copy
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.objective import (
    OBJECTIVE,
    Objective,
    balanced_weights,
    empty_truth_losses,
    frozen,
    objective_and_gradient,
)
from skyproof.attacks.search import search_step
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import (
    describe_camouflage,
    load_camouflage,
    read_record,
    save_camouflage,
)
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.inference import device_of
from skyproof.detectors.weights import weights_digest
from skyproof.errors import ConfigurationError, NotFiniteError
from skyproof.files import alone, write_beside
from skyproof.loop import Loop, Part, refuse_other
from skyproof.storage import tensors_digest

_LITTLE = 0.02
"""An attack is done when twice the steps hide no larger a share more."""

_OTHER = "an attack with other settings or on other detectors"


def attack(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
    folder: str | Path,
    *,
    held_out: HeldOut | None = None,
    record: Callable[[], Mapping[str, Any]] | None = None,
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> Camouflage:
    """Optimises the camouflage so that the ensemble's losses against an empty truth fall.

    The weights of the losses make every detector's term 1 on vehicles without camouflage, whatever
    the start hides. Scenes depend on the seed and the step alone, so a stopped attack goes on
    exactly where it was from its last checkpoint. A finished folder is not touched again. A control
    that is to be searched for ("R-PixFc_search") takes random changes instead of gradients, on as
    many images; it needs larger batches, which `AttackSettings.of_search` gives it.

    Differences from the paper: losses are normalised per image and the weights computed, not
    chosen; what falls is the sum of their logarithms (see `objective`), not of the losses
    themselves; the optimiser, which the paper does not name, is Adam.

    Args:
        camouflage: on the device to work on; optimised in place.
        detectors: on the same device; not changed, which is checked.
        world: what the attack sees.
        settings: steps, batch, learning rate, seed.
        folder: gets `steps.jsonl`, `previews/`, and at the end the camouflage (see
            `save_camouflage`).
        held_out: scenes on which a learnt camouflage is judged half-way and at the end, so that
            `camouflage.json` says whether the attack has converged; not where not given.
        record: gives further facts to store with the camouflage; asked before the first step, when
            nobody else can begin in the folder any more, and not where it is finished.
        on_step: called with each row of `steps.jsonl`.

    Returns:
        The camouflage, finished.

    Raises:
        ConfigurationError: the camouflage has nothing to learn, or a detector's loss is below zero.
        NotFiniteError: a loss or the camouflage is no longer finite; the last checkpoint stays.
        RunFolderError: the folder holds an attack with other settings or detectors, from another
            start or in another world, somebody else works there, or the disk is full.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    identity = {
        "camouflage": str(camouflage.name),
        "detectors": {detector.name: weights_digest(detector) for detector in detectors},
        "settings": asdict(settings),
        "scenes": asdict(world.scenes),
        "objective": OBJECTIVE,
        "start": _start(camouflage),
        "world_sha256": world.digest,
    }
    if (folder / "camouflage.json").exists():
        return _finished(camouflage, folder, identity)
    parts: dict[str, Part] = {"camouflage": camouflage}
    if camouflage.name.choice != "search":
        optimiser = make_optimiser(camouflage, settings)
        schedule = LambdaLR(optimiser, lambda step: _half_cosine(step / settings.steps))
        parts |= {"optimiser": optimiser, "schedule": schedule}
    loop = Loop(
        folder,
        identity,
        settings.steps,
        settings.checkpoint_every,
        parts,
        other=_OTHER,
        remedy=f"remove {folder} and attack again",
        on_row=on_step,
    )
    with alone(folder):
        # Somebody else may have finished it in the meantime.
        if (folder / "camouflage.json").exists():
            return _finished(camouflage, folder, identity)
        more = record() if record else {}
        loop.resume()
        with frozen(detectors):
            judge = None if camouflage.name.choice == "search" else held_out
            facts = _take_steps(camouflage, detectors, world, settings, loop, judge)
        save_camouflage(folder, camouflage, {"attack": identity, **facts, **more})
        loop.forget()
    return camouflage


def _start(camouflage: Camouflage) -> dict[str, Any]:
    """What an attack begins with and does not learn: fixed colours, a texture under a shape."""
    learnt = {name for name, value in camouflage.named_parameters() if value.requires_grad}
    kept = {name: part for name, part in camouflage.state_dict().items() if name not in learnt}
    return {**describe_camouflage(camouflage), "kept_sha256": tensors_digest(kept)}


def _finished(camouflage: Camouflage, folder: Path, identity: Mapping[str, Any]) -> Camouflage:
    refuse_other(folder, read_record(folder).get("attack"), identity, _OTHER)
    camouflage.load_state_dict(load_camouflage(folder).state_dict())
    return camouflage


def _take_steps(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
    loop: Loop,
    held_out: HeldOut | None,
) -> dict[str, Any]:
    """Takes the steps that are left, and finalises the camouflage; returns what is recorded."""
    if "weights" not in loop.facts:
        loop.facts["weights"] = attack_weights(detectors, world, settings)
    weights: dict[str, float] = loop.facts["weights"]

    searched = camouflage.name.choice == "search"
    for step in loop:
        if searched:
            now, images = search_step(camouflage, detectors, weights, world, settings, step)
        else:
            now, images = _learn(camouflage, detectors, world, settings, loop)
        loop.report({"step": step, "loss": now.loss, "losses": now.losses, "weights": weights})
        if step % settings.preview_every == 0 or step in (1, settings.steps):
            _write_preview(loop.folder / "previews" / f"{step:06d}.png", images.detach())
        if step in settings.keep_at:
            _snapshot(camouflage, f"step{step}", loop.folder, finalise=True)
        if held_out is not None and step == settings.steps // 2:
            half_way = copy.deepcopy(camouflage)
            half_way.finalise()
            loop.facts["hidden_half_way"] = held_out.judge(half_way).hidden

    if settings.keep_at:
        _snapshot(camouflage, "relaxed", loop.folder, finalise=False)
    before = _measure(camouflage, detectors, world, settings)
    camouflage.finalise()
    after = _measure(camouflage, detectors, world, settings)
    facts = {
        "weights": weights,
        "discretisation": {"before": _means(before), "after": _means(after)},
    }
    if held_out is not None and "hidden_half_way" in loop.facts:
        facts["convergence"] = _convergence(camouflage, held_out, settings, loop)
    return facts


def _convergence(
    camouflage: Camouflage, held_out: HeldOut, settings: AttackSettings, loop: Loop
) -> dict[str, Any]:
    """Says what twice the steps added: the second half of them.

    The learning rate is still high half-way, where less is hidden than an attack of so many steps
    would have hidden.
    """
    hidden = [loop.facts["hidden_half_way"], held_out.judge(camouflage).hidden]
    return {
        "steps": [settings.steps // 2, settings.steps],
        "hidden": hidden,
        "scenes": held_out.scenes(),
        "converged": hidden[1] - hidden[0] <= _LITTLE,
    }


def _learn(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
    loop: Loop,
) -> tuple[Objective, Float[Tensor, "B 3 H W"]]:
    """Takes the loop's step along the gradient; returns the objective before it, and its images."""
    step = loop.step
    weights: dict[str, float] = loop.facts["weights"]
    camouflage.before_step_(step, settings.steps)
    scenes = world.step_scenes(settings.batch_size, settings.seed, step)
    images = world.frames(camouflage, scenes).image
    now, gradient = objective_and_gradient(detectors, weights, images)
    if not math.isfinite(now.loss):
        raise NotFiniteError(
            f"The loss of {camouflage.name} is {now.loss} at step {step}; attack again in another "
            f"folder, with a lower --settings.learning-rate than {settings.learning_rate:g}."
        )
    descend(camouflage, cast(torch.optim.Adam, loop.parts["optimiser"]), images, gradient)
    cast(LambdaLR, loop.parts["schedule"]).step()
    return now, images


def attack_weights(
    detectors: Sequence[TrainableDetector], world: World, settings: AttackSettings
) -> dict[str, float]:
    """Gives the weights of the losses: every detector's term is 1 without camouflage.

    Raises:
        ConfigurationError: a detector's loss is below zero.
        NotFiniteError: a loss is not finite.
    """
    return balanced_weights(_measure(None, detectors, world, settings))


def make_optimiser(camouflage: Camouflage, settings: AttackSettings) -> torch.optim.Adam:
    """Makes Adam for the start of an attack, with a learning rate of its own for every parameter.

    Raises:
        ConfigurationError: no parameter is there to be learnt.
    """
    groups = [
        {
            "params": [value],
            "lr": settings.learning_rate * camouflage.learning_rates.get(name, 1.0),
        }
        for name, value in camouflage.named_parameters()
        # The finished texture under a sequential attack's shape is not learnt.
        if value.requires_grad
    ]
    if not groups:
        raise ConfigurationError(
            f"{camouflage.name} has nothing to learn; attack with one that is not finished."
        )
    return torch.optim.Adam(groups)


def descend(
    camouflage: Camouflage,
    optimiser: torch.optim.Optimizer,
    images: Float[Tensor, "B 3 H W"],
    gradient: Float[Tensor, "B 3 H W"],
) -> None:
    """Moves the camouflage one step down, by the gradient of a loss with respect to its images."""
    optimiser.zero_grad(set_to_none=True)
    images.backward(gradient)
    optimiser.step()
    camouflage.project_()


def _half_cosine(share: float) -> float:
    """What is left of the learning rate after a share of the steps: from 1 to a tenth."""
    return 0.55 + 0.45 * math.cos(math.pi * share)


@torch.no_grad()
def _measure(
    camouflage: Camouflage | None,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
) -> dict[str, list[float]]:
    """Every detector's mean loss on each of the batches that no step sees, with a camouflage or
    without any.
    """
    means: dict[str, list[float]] = {detector.name: [] for detector in detectors}
    for batch in range(settings.balance_batches):
        scenes = world.step_scenes(settings.batch_size, settings.seed, -batch)
        if camouflage is None:
            images = world.bare(scenes, device_of(detectors[0])).image
        else:
            images = world.frames(camouflage, scenes).image
        for name, losses in empty_truth_losses(detectors, images).items():
            means[name].append(float(losses.mean()))
            if not math.isfinite(means[name][-1]):
                raise NotFiniteError(
                    f"The loss of the detector {name} is {means[name][-1]} on the attack's scenes; "
                    "train or import it again."
                )
            if float(losses.min()) < 0:
                raise ConfigurationError(
                    f"The loss of the detector {name} is {float(losses.min()):g} on one of the "
                    "attack's images, and an attack takes its logarithm; give it a loss that is 0 "
                    "where nothing is detected, and never below."
                )
    return means


def _means(losses: Mapping[str, Sequence[float]]) -> dict[str, float]:
    return {name: statistics.fmean(values) for name, values in losses.items()}


def _snapshot(camouflage: Camouflage, variant: str, folder: Path, *, finalise: bool) -> None:
    """Stores a copy of the camouflage as it is now, under a name of its own.

    "T-U-0" after 10 steps is "T-U_step10-0".
    """
    copied = copy.deepcopy(camouflage)
    copied.name = camouflage.name.with_variant(variant)
    if finalise:
        copied.finalise()
    record = {"of": str(camouflage.name), "variant": variant}
    save_camouflage(folder / "snapshots" / str(copied.name), copied, record)


def _write_preview(path: Path, images: Float[Tensor, "B 3 H W"]) -> None:
    """Writes the first images of a batch side by side."""
    levels = (images[:8] * 255).round().byte().cpu()
    row = torch.cat(list(levels), dim=2).permute(1, 2, 0).numpy()
    with write_beside(path) as temporary:
        Image.fromarray(row).save(temporary)
