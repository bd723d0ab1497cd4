"""The attack: random scenes, a camouflage, an ensemble of frozen detectors (section 3.2)."""

import copy
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from skyproof.attacks.held_out import HeldOut, at_a_time
from skyproof.attacks.objective import (
    OBJECTIVES,
    Objective,
    balanced_weights,
    empty_truth_losses,
    frozen,
    objective,
    objective_and_gradient,
)
from skyproof.attacks.settings import AttackSettings, Method
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
from skyproof.errors import ConfigurationError, NotFiniteError
from skyproof.files import alone
from skyproof.loop import Loop, LoopPart, refuse_other
from skyproof.pictures import write_png
from skyproof.render.frames import Frames
from skyproof.scenes.scene import Scene
from skyproof.storage import tensors_digest, weights_digest

_CONVERGED = 0.02
"""An attack has converged if twice the steps hide a share that is larger by at most this."""

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

    The weights of the losses make every detector's term 1 on vehicles without camouflage (method
    "paper": in the camouflage as it starts). Scenes depend on the seed and the step alone, so a
    stopped attack continues exactly from its last checkpoint. A finished folder is not touched
    again. A search control ("R-PixFc_search") takes random changes instead of gradients, on as many
    images, with `AttackSettings.of_search`. The differences from the paper are at `AttackSettings`,
    `objective` and `balanced_weights`.

    Args:
        camouflage: on the device to work on; optimised in place.
        detectors: on the same device; not changed, which is checked.
        world: world of the attack.
        settings: method, steps, batch, learning rate, seed.
        folder: gets `steps.jsonl`, `previews/`, and at the end the camouflage.
        held_out: measures the camouflage half-way and at the end, so that `camouflage.json` says
            whether the attack has converged.
        record: gives further facts to store with the camouflage. It runs before the first step,
            under the folder's lock, and not for a finished folder.
        on_step: called with each row of `steps.jsonl`.

    Raises:
        ConfigurationError: the camouflage has no parameter to optimise, or a detector's loss is
            below zero.
        NotFiniteError: a loss or the camouflage is no longer finite; the last checkpoint stays.
        RunFolderError: the folder holds an attack with other settings, detectors, start or world,
            another process works there, or the disk is full.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    identity = {
        "camouflage": str(camouflage.name),
        "detectors": {detector.name: weights_digest(detector) for detector in detectors},
        "settings": asdict(settings),
        "scenes": asdict(world.scenes),
        "objective": OBJECTIVES[settings.method],
        "start": _start(camouflage),
        "world_sha256": world.digest,
    }
    if (folder / "camouflage.json").exists():
        return _finished(camouflage, folder, identity)
    parts: dict[str, LoopPart] = {"camouflage": camouflage}
    optimiser = None
    if camouflage.name.choice == "search":
        held_out = None
    else:
        optimiser = make_optimiser(camouflage, settings)
        # Half a cosine takes the learning rate to a tenth.
        schedule = LambdaLR(
            optimiser, lambda step: 0.55 + 0.45 * math.cos(math.pi * (step / settings.steps))
        )
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
        # Another process may have finished it in the meantime.
        if (folder / "camouflage.json").exists():
            return _finished(camouflage, folder, identity)
        if optimiser is not None:
            camouflage.paper_form_(settings.method == "paper")
        more = record() if record else {}
        loop.resume()
        run = _Run(camouflage, detectors, world, settings, loop, held_out)
        with frozen(detectors):
            if optimiser is None:
                facts = run.take_steps(run.search)
            else:
                facts = run.take_steps(lambda: run.descend(optimiser, schedule))
        save_camouflage(folder, camouflage, {"attack": identity, **facts, **more})
        loop.forget()
    return camouflage


def _start(camouflage: Camouflage) -> dict[str, Any]:
    """Describes what an attack starts from and keeps: fixed colours, a texture under a shape."""
    moving = {name for name, value in camouflage.named_parameters() if value.requires_grad}
    kept = {name: part for name, part in camouflage.state_dict().items() if name not in moving}
    return {**describe_camouflage(camouflage), "kept_sha256": tensors_digest(kept)}


def _finished(camouflage: Camouflage, folder: Path, identity: Mapping[str, Any]) -> Camouflage:
    refuse_other(folder, read_record(folder).get("attack"), identity, _OTHER)
    camouflage.load_state_dict(load_camouflage(folder).state_dict())
    return camouflage


_Batch = tuple[Objective, Float[Tensor, "B 3 H W"]]
"""The objective before a step, and its images."""


@dataclass(frozen=True)
class _Run:
    """One attack; attributes as in `attack`."""

    camouflage: Camouflage
    detectors: Sequence[TrainableDetector]
    world: World
    settings: AttackSettings
    loop: Loop
    held_out: HeldOut | None

    def take_steps(self, take: Callable[[], _Batch]) -> dict[str, Any]:
        """Takes the remaining steps and finalises the camouflage; returns the facts to record."""
        camouflage, settings, facts = self.camouflage, self.settings, self.loop.facts
        if "weights" not in facts:
            facts["weights"] = attack_weights(camouflage, self.detectors, self.world, settings)
        for step in self.loop:
            now, images = take()
            self.loop.report({"step": step, **now._asdict(), "weights": facts["weights"]})
            if step % settings.preview_every == 0 or step in (1, settings.steps):
                _write_preview(self.loop.folder / "previews" / f"{step:06d}.png", images)
            if step in settings.keep_at:
                self._snapshot(f"step{step}")
            if self.held_out is not None and step == settings.steps // 2:
                half_way = copy.deepcopy(camouflage)
                half_way.finalise()
                facts["hidden_half_way"] = self.held_out.measure(half_way).hidden
        rounding = {"before": self._mean_losses()}
        camouflage.finalise()
        rounding["after"] = self._mean_losses()
        recorded = {"weights": facts["weights"], "discretisation": rounding}
        if self.held_out is not None and "hidden_half_way" in facts:
            # Half-way, the learning rate is still high, so less is hidden than at the end of an
            # attack with half as many steps.
            hidden = [facts["hidden_half_way"], self.held_out.measure(camouflage).hidden]
            recorded["convergence"] = {
                "steps": [settings.steps // 2, settings.steps],
                "hidden": hidden,
                "scenes": self.held_out.scenes(),
                "converged": hidden[1] - hidden[0] <= _CONVERGED,
            }
        return recorded

    def search(self) -> _Batch:
        """Tries a random change on half a batch, so in as many passes, and keeps it if better."""
        settings, step = self.settings, self.loop.step
        scenes = self.world.step_scenes(max(1, settings.batch_size // 2), settings.seed, step)
        other = copy.deepcopy(self.camouflage)
        other.vary_(torch.Generator().manual_seed((settings.seed * 1_000_033 + step) % 2**63))

        @torch.no_grad()
        def show(camouflage: Camouflage) -> _Batch:
            images = self.world.frames(camouflage, scenes).image
            weights = self.loop.facts["weights"]
            return objective(self.detectors, weights, images, settings.method), images

        before, after = at_a_time(show, (self.camouflage, other), self.detectors)
        if after[0].loss < before[0].loss:
            self.camouflage.load_state_dict(other.state_dict())
            return after
        return before

    def descend(self, optimiser: torch.optim.Adam, schedule: LambdaLR) -> _Batch:
        """Takes a step along the gradient."""
        camouflage, settings, step = self.camouflage, self.settings, self.loop.step
        camouflage.before_step_(step, settings.steps)
        scenes = self.world.step_scenes(settings.batch_size, settings.seed, step)
        weights = self.loop.facts["weights"]
        now, shown = add_gradients(
            camouflage, self.detectors, weights, self.world, scenes, settings.method
        )
        if not math.isfinite(now.loss):
            raise NotFiniteError(
                f"The loss of {camouflage.name} is {now.loss} at step {step}; attack again in "
                f"another folder, with a lower learning rate than {settings.learning_rate:g}."
            )
        descend(camouflage, optimiser)
        schedule.step()
        return now, torch.cat([frames.image for frames in shown])

    def _mean_losses(self) -> dict[str, float]:
        losses = _losses(self.camouflage, self.detectors, self.world, self.settings)
        return {name: statistics.fmean(values) for name, values in losses.items()}

    def _snapshot(self, variant: str) -> None:
        """Stores a finished copy under its own name: "T-U_step10-0" is "T-U-0" after 10 steps."""
        copied = copy.deepcopy(self.camouflage)
        copied.name = self.camouflage.name.with_variant(variant)
        copied.paper_form_(False)
        copied.finalise()
        record = {"of": str(self.camouflage.name), "variant": variant}
        save_camouflage(self.loop.folder / "snapshots" / str(copied.name), copied, record)


def attack_weights(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
) -> dict[str, float]:
    """Returns the weights that make every detector's term 1, as `attack` describes."""
    worn = camouflage if settings.method == "paper" else None
    return balanced_weights(_losses(worn, detectors, world, settings))


def make_optimiser(camouflage: Camouflage, settings: AttackSettings) -> torch.optim.Adam:
    """Makes Adam for the start of an attack, with a learning rate for every parameter."""
    # The paper gives no rates, so by its method all are alike.
    rates = {} if settings.method == "paper" else camouflage.learning_rates
    groups = [
        {"params": [value], "lr": settings.learning_rate * rates.get(name, 1.0)}
        for name, value in camouflage.named_parameters()
        # A sequential attack keeps the finished texture under its shape.
        if value.requires_grad
    ]
    if not groups:
        raise ConfigurationError(
            f"{camouflage.name} has nothing to optimise; attack with one that is not finished."
        )
    return torch.optim.Adam(groups)


def add_gradients(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    weights: Mapping[str, float],
    world: World,
    scenes: Sequence[Scene],
    method: Method = "skyproof",
) -> tuple[Objective, list[Frames]]:
    """Adds the gradient of the objective on some scenes to that of the camouflage's parameters.

    On a CPU two halves of the scenes are worked on at a time, whatever the number of cores, so that
    the sum is the same. Returns the objective, and the frames, which hold no gradient any more.
    """
    moving = [value for value in camouflage.parameters() if value.requires_grad]

    def show(part: Sequence[Scene]) -> tuple[Objective, Frames, Sequence[Tensor | None]]:
        frames = world.frames(camouflage, part)
        share = len(part) / len(scenes)
        now, gradient = objective_and_gradient(detectors, weights, frames.image, share, method)
        gradients = torch.autograd.grad(frames.image, moving, gradient, allow_unused=True)
        return now, replace(frames, image=frames.image.detach()), gradients

    halves = [scenes]
    if device_of(camouflage).type == "cpu" and len(scenes) > 1:
        middle = len(scenes) // 2
        halves = [scenes[:middle], scenes[middle:]]
    parts = at_a_time(show, halves, detectors)
    for _, _, gradients in parts:
        for value, gradient in zip(moving, gradients, strict=True):
            if gradient is not None:
                value.grad = gradient if value.grad is None else value.grad + gradient
    losses = {name: sum(now.losses[name] for now, _, _ in parts) for name in parts[0][0].losses}
    now = Objective(sum(now.loss for now, _, _ in parts), losses)
    return now, [frames for _, frames, _ in parts]


def descend(camouflage: Camouflage, optimiser: torch.optim.Optimizer) -> None:
    """Moves the camouflage one step down the gradient of its parameters, and clears it."""
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)
    camouflage.project_()


@torch.no_grad()
def _losses(
    camouflage: Camouflage | None,
    detectors: Sequence[TrainableDetector],
    world: World,
    settings: AttackSettings,
) -> dict[str, list[float]]:
    """Returns every detector's mean loss on each of the batches that no step sees."""
    means: dict[str, list[float]] = {detector.name: [] for detector in detectors}
    for batch in range(settings.balance_batches):
        scenes = world.step_scenes(settings.batch_size, settings.seed, -batch)
        images = world.frames(camouflage, scenes, device_of(detectors[0])).image
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
                    "attack's images; give it a loss that is 0 where nothing is detected, and "
                    "never below."
                )
    return means


def _write_preview(path: Path, images: Float[Tensor, "B 3 H W"]) -> None:
    """Writes the first images of a batch side by side."""
    levels = (images[:8] * 255).round().byte().cpu()
    row = torch.cat(list(levels), dim=2).permute(1, 2, 0).numpy()
    write_png(path, row)
