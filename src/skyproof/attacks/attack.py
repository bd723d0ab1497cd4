"""The optimisation loop: random scenes, a camouflage, an ensemble of frozen detectors (PAPER 21, 24, 25)."""

from __future__ import annotations

import copy
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from skyproof.attacks.objective import balanced_weights, empty_truth_losses, frozen
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.weights import weights_digest
from skyproof.errors import ConfigurationError, RunFolderError, StoredFileError
from skyproof.files import (
    read_json,
    read_jsonl,
    refuse_foreign,
    write_beside,
    write_bytes,
    write_json,
    write_jsonl,
)

__all__ = ["attack", "make_optimiser"]

_CHECKPOINT = "checkpoint.safetensors"


def attack(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: AttackWorld,
    settings: AttackSettings,
    folder: str | Path,
    *,
    record: Mapping[str, Any] | None = None,
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> Camouflage:
    """Optimises the camouflage so that the ensemble's losses against an empty truth fall (PAPER 21).

    Loss = sum over detectors of weight * mean over images of the detector's own loss; the weights make every term 1 at
    the start. Adam. Scenes depend on the seed and the step alone, so a stopped attack goes on exactly where it was
    from its last checkpoint. A finished folder is not touched again.

    Differences from the paper: losses are normalised per image (PAPER 22) and the weights computed, not chosen.

    Args:
        camouflage: on the device to work on; optimised in place.
        detectors: on the same device; not changed, which is checked.
        folder: gets `steps.jsonl`, `previews/`, and at the end the camouflage (see `save_camouflage`).
        record: further facts to store with the camouflage.
        on_step: called with each row of `steps.jsonl`.

    Raises:
        RunFolderError: the folder holds an attack with other settings or detectors, or the disk is full.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    identity = {
        "camouflage": str(camouflage.name),
        "detectors": {detector.name: weights_digest(detector) for detector in detectors},
        "settings": asdict(settings),
        "scenes": asdict(world.scenes),
    }
    if (folder / "camouflage.json").exists():
        document = read_json(folder / "camouflage.json")
        stored = document.get("record") if isinstance(document, dict) else None
        _same_attack(stored.get("attack") if isinstance(stored, dict) else None, identity, folder)
        camouflage.load_state_dict(load_camouflage(folder).state_dict())
        return camouflage
    run = _Run(camouflage, settings, identity)
    run.resume(folder)
    with frozen(detectors):
        if not run.weights:
            run.weights = balanced_weights(_measure(camouflage, detectors, world, settings))
            run.claim(folder)
        while run.step < settings.steps:
            started = time.perf_counter()
            images, losses = run.advance(detectors, world)
            row = {
                "step": run.step,
                "loss": sum(run.weights[name] * value for name, value in losses.items()),
                "losses": losses,
                "weights": run.weights,
                "seconds": round(time.perf_counter() - started, 4),
            }
            run.rows.append(row)
            if run.step % settings.preview_every == 0 or run.step in (1, settings.steps):
                _write_preview(folder / "previews" / f"{run.step:06d}.png", images)
            if run.step in settings.keep_at:
                _snapshot(camouflage, f"step{run.step}", folder, finalise=True)
            if run.step % settings.checkpoint_every == 0 and run.step < settings.steps:
                run.store(folder)
            if on_step is not None:
                on_step(row)
        if settings.keep_at:
            _snapshot(camouflage, "relaxed", folder, finalise=False)
        before = _measure(camouflage, detectors, world, settings)
        camouflage.finalise()
        gap = {"before": before, "after": _measure(camouflage, detectors, world, settings)}
    write_jsonl(folder / "steps.jsonl", run.rows)
    discretisation = {
        when: {name: statistics.fmean(each) for name, each in found.items()}
        for when, found in gap.items()
    }
    facts = {"attack": identity, "weights": run.weights, "discretisation": discretisation}
    save_camouflage(folder, camouflage, {**facts, **(record or {})})
    (folder / _CHECKPOINT).unlink(missing_ok=True)
    (folder / "checkpoint.json").unlink(missing_ok=True)
    return camouflage


def make_optimiser(camouflage: Camouflage, settings: AttackSettings) -> torch.optim.Adam:
    """Adam at the start of an attack; every parameter's own rate is also kept as "first_lr" of its group.

    Raises:
        ConfigurationError: no parameter is there to be learnt.
    """
    groups = []
    for name, value in camouflage.named_parameters():
        # The finished texture under a sequential attack's shape is not learnt.
        if value.requires_grad:
            rate = settings.learning_rate * camouflage.learning_rates.get(name, 1.0)
            groups.append({"params": [value], "lr": rate, "first_lr": rate})
    if not groups:
        raise ConfigurationError(
            f"{camouflage.name} has nothing to learn; attack with one that is not finished."
        )
    return torch.optim.Adam(groups)


@torch.no_grad()
def _measure(
    camouflage: Camouflage,
    detectors: Sequence[TrainableDetector],
    world: AttackWorld,
    settings: AttackSettings,
) -> dict[str, list[float]]:
    """Every detector's mean loss on each of the batches that no step sees."""
    found: dict[str, list[float]] = {detector.name: [] for detector in detectors}
    for batch in range(settings.balance_batches):
        images = world.frames(
            camouflage, world.step_scenes(settings.batch_size, settings.seed, -batch)
        ).image
        for name, losses in empty_truth_losses(detectors, images).items():
            found[name].append(float(losses.mean()))
    return found


def _snapshot(camouflage: Camouflage, variant: str, folder: Path, *, finalise: bool) -> None:
    """A copy of the camouflage as it is now, under a name of its own: "T-U-0" after 10 steps is "T-U_step10-0"."""
    copied = copy.deepcopy(camouflage)
    copied.name = camouflage.name.with_variant(variant)
    if finalise:
        copied.finalise()
    record = {"of": str(camouflage.name), "variant": variant}
    save_camouflage(folder / "snapshots" / str(copied.name), copied, record)


class _Run:
    """All that changes during an attack."""

    def __init__(
        self, camouflage: Camouflage, settings: AttackSettings, identity: dict[str, Any]
    ) -> None:
        self.camouflage, self.settings = camouflage, settings
        self.identity = json.loads(json.dumps(identity))
        self.optimiser = make_optimiser(camouflage, settings)
        self.weights: dict[str, float] = {}
        self.rows: list[dict[str, Any]] = []
        self.step = 0

    def advance(
        self, detectors: Sequence[TrainableDetector], world: AttackWorld
    ) -> tuple[UInt8[Tensor, "B 3 H W"], dict[str, float]]:
        """One step; returns the batch's images and every detector's mean loss before it."""
        share = self.step / self.settings.steps
        for group in self.optimiser.param_groups:
            group["lr"] = group["first_lr"] * (0.55 + 0.45 * math.cos(math.pi * share))
        self.step += 1
        self.camouflage.before_step_(self.step, self.settings.steps)
        scenes = world.step_scenes(self.settings.batch_size, self.settings.seed, self.step)
        images = world.frames(self.camouflage, scenes).image
        # One detector at a time, so that only one network's activations are held.
        leaf = images.detach().contiguous(memory_format=torch.channels_last).requires_grad_()
        losses = {}
        for detector in detectors:
            loss = empty_truth_losses([detector], leaf)[detector.name].mean()
            (self.weights[detector.name] * loss).backward()
            losses[detector.name] = float(loss.detach())
        self.optimiser.zero_grad(set_to_none=True)
        images.backward(leaf.grad)
        self.optimiser.step()
        self.camouflage.project_()
        return (leaf.detach() * 255).round().byte(), losses

    def claim(self, folder: Path) -> None:
        """Marks the folder as this attack's before anything else is written to it."""
        write_json(folder / "checkpoint.json", {"identity": self.identity, "weights": self.weights})

    def store(self, folder: Path) -> None:
        """Writes a checkpoint; the tensors come last and say their step."""
        tensors = {
            f"camouflage.{name}": value for name, value in self.camouflage.state_dict().items()
        }
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": value for name, value in state.items()}
        tensors["step"] = torch.tensor(self.step)
        tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        write_jsonl(folder / "steps.jsonl", self.rows)
        write_bytes(folder / _CHECKPOINT, save(tensors))

    def resume(self, folder: Path) -> None:
        """Goes back to the last checkpoint, if there is one."""
        if not (folder / "checkpoint.json").exists():
            refuse_foreign(folder, ())
            return
        record = read_json(folder / "checkpoint.json")
        _same_attack(
            record.get("identity") if isinstance(record, dict) else None, self.identity, folder
        )
        if not (folder / _CHECKPOINT).exists():
            return
        try:
            tensors = load_file(folder / _CHECKPOINT)
            state = {
                k.removeprefix("camouflage."): v
                for k, v in tensors.items()
                if k.startswith("camouflage.")
            }
            self.camouflage.load_state_dict(state)
            adam: dict[int, dict[str, Tensor]] = {}
            for name, value in tensors.items():
                if name.startswith("adam."):
                    _, index, field = name.split(".")
                    adam.setdefault(int(index), {})[field] = value
            self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": adam})
            self.step = int(tensors["step"])
            self.weights = record["weights"]
        except (SafetensorError, OSError, KeyError, ValueError, RuntimeError) as error:
            path = folder / _CHECKPOINT
            raise StoredFileError(
                f"{path} is damaged ({error}); remove {folder} and attack again."
            ) from error
        # A kill between two files can leave rows of later steps.
        self.rows = [row for row in read_jsonl(folder / "steps.jsonl") if row["step"] <= self.step]


def _same_attack(stored: Any, wanted: dict[str, Any], folder: Path) -> None:
    if stored != json.loads(json.dumps(wanted)):
        raise RunFolderError(
            f"{folder} holds an attack with other settings or on other detectors; choose another folder or remove it."
        )


def _write_preview(path: Path, images: UInt8[Tensor, "B 3 H W"]) -> None:
    row = torch.cat(list(images[:8].cpu()), dim=2).permute(1, 2, 0).numpy()
    with write_beside(path) as temporary:
        Image.fromarray(row).save(temporary)
