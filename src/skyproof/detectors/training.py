"""Training a detector from nothing: one plain loop that survives a kill (PAPER 16, 18)."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision, best_f1_threshold
from skyproof.detectors.batches import WINDOW_PX, training_batches
from skyproof.detectors.card import DetectorCard, installed_version
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector, save_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.weights import plain_state
from skyproof.errors import ConfigurationError, RunFolderError, StoredFileError
from skyproof.files import read_jsonl, refuse_foreign, write_bytes, write_jsonl

__all__ = [
    "check_validation",
    "train",
    "validate",
]

CHECKPOINT = "checkpoint.safetensors"


def train(
    detector: TrainableDetector,
    training: Dataset,
    validation: Dataset,
    settings: TrainingSettings,
    folder: Path,
    *,
    generator: torch.Generator,
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> DetectorCard:
    """Trains `detector` where it lies, and leaves the best averaged weights in it and in `folder`.

    A finished folder is loaded and not trained again. An unfinished one goes on from its checkpoint with the same
    order of images and the same augmentation; on a CPU with the same number of threads the result is the same bit for
    bit as without the interruption.

    Args:
        detector: fresh from `build_detector`, on the device to train on.
        training: images of any sizes, with or without vehicles; ignore regions are painted over with the mean colour,
            and of images larger than 384 px random windows are shown (see `batches.window`).
        validation: chooses the best weights (centre AP, then F1) and freezes the threshold (PAPER 18).
        settings: see `TRAINING_PRESETS`.
        folder: gets `weights.safetensors`, `detector.json`, `steps.jsonl`; `checkpoint.safetensors` until finished.
        generator: one number is drawn from it: the seed of order and augmentation.
        on_step: called with each row of `steps.jsonl`, for progress display.

    Returns:
        The card of the stored detector.

    Raises:
        ConfigurationError: no training image, no vehicle to validate with, or the loss stopped being finite.
        RunFolderError: the folder holds a training with other settings, or the disk is full.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    seed = int(torch.randint(2**62, (1,), generator=generator))
    identity = {
        "name": detector.name,
        "size": detector.size,
        "seed": seed,
        "settings": asdict(settings),
    }
    _check(training, validation)
    if (folder / "detector.json").exists():
        return _finished(detector, folder, identity)
    run = _Run(detector, settings, identity)
    run.resume(folder)
    batches = training_batches(
        training,
        range(run.step, settings.steps),
        batch_size=settings.batch_size,
        jitter_strength=settings.jitter,
        seed=seed,
    )
    while run.step < settings.steps:
        started = time.perf_counter()
        loss = run.advance(*next(batches))
        row = {
            "kind": "step",
            "step": run.step,
            "loss": loss,
            "learning_rate": _learning_rate(run.step - 1, settings),
            "seconds": round(time.perf_counter() - started, 4),
        }
        rows = [row]
        if run.step % settings.validate_every == 0 or run.step == settings.steps:
            started = time.perf_counter()
            scores = validate(run.averaged, validation)
            run.keep_if_best(scores)
            seconds = round(time.perf_counter() - started, 4)
            rows.append({"kind": "validation", "step": run.step, **scores, "seconds": seconds})
        run.rows.extend(rows)
        if run.step % settings.checkpoint_every == 0 or run.step == settings.steps:
            run.store(folder)
        for each in rows:
            if on_step is not None:
                on_step(each)
    return _finish(run, training, folder)


def validate(detector: Detector, validation: Dataset) -> dict[str, float]:
    """Centre AP, IoU-0.5 AP, best F1 (centre) and its threshold (PAPER 17, 18)."""
    found = detect_all(detector, validation)
    centre = average_precision(found, validation, criterion="centre_1m")
    overlap = average_precision(found, validation, criterion="iou_50")
    threshold, f1 = best_f1_threshold(centre)
    return {"ap_centre_1m": centre.ap, "ap_iou_50": overlap.ap, "f1": f1, "threshold": threshold}


class _Run:
    """Everything that changes during a training, so that a checkpoint can hold all of it."""

    def __init__(
        self, detector: TrainableDetector, settings: TrainingSettings, identity: dict[str, Any]
    ) -> None:
        self.detector = detector.train().to(memory_format=torch.channels_last)
        self.averaged = copy.deepcopy(detector).eval().requires_grad_(False)
        self.settings = settings
        self.identity = identity
        self.step = 0
        self.rows: list[dict[str, Any]] = []
        self.best: dict[str, float] = {}
        self.best_state: dict[str, Tensor] = {}
        decayed = [parameter for parameter in detector.parameters() if parameter.ndim > 1]
        others = [parameter for parameter in detector.parameters() if parameter.ndim <= 1]
        groups = [
            {"params": decayed, "weight_decay": settings.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate)

    def advance(self, images: Tensor, targets: Sequence[Tensor]) -> float:
        """One optimiser step; returns the mean loss."""
        settings = self.settings
        device = next(self.detector.parameters()).device
        images = images.to(device).contiguous(memory_format=torch.channels_last)
        for group in self.optimiser.param_groups:
            group["lr"] = _learning_rate(self.step, settings)
        loss = self.detector.loss(images, [boxes.to(device) for boxes in targets]).mean()
        if not torch.isfinite(loss):
            raise ConfigurationError(
                f"The training loss is {float(loss)} at step {self.step}; train again with a lower learning rate "
                f"than {settings.learning_rate}."
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.detector.parameters(), settings.largest_gradient_norm)
        self.optimiser.step()
        self.step += 1
        self._average()
        return float(loss.detach())

    @torch.no_grad()
    def _average(self) -> None:
        # Early on the average must forget the untrained weights quickly.
        decay = min(self.settings.average_decay, self.step / (self.step + 10))
        current = self.detector.state_dict()
        for name, kept in self.averaged.state_dict().items():
            if kept.is_floating_point():
                kept.lerp_(current[name], 1 - decay)
            else:
                kept.copy_(current[name])

    def keep_if_best(self, scores: dict[str, float]) -> None:
        # Centre AP is compared to 0.01 points: below that F1 decides.
        def rank(values: dict[str, float]) -> tuple[float, float]:
            return round(values["ap_centre_1m"], 4), values["f1"]

        if not self.best or rank(scores) >= rank(self.best):
            self.best = {**scores, "step": self.step}
            self.best_state = plain_state(self.averaged)

    def store(self, folder: Path) -> None:
        tensors = {f"weights.{name}": tensor for name, tensor in plain_state(self.detector).items()}
        tensors |= {
            f"averaged.{name}": tensor for name, tensor in plain_state(self.averaged).items()
        }
        tensors |= {f"best.{name}": tensor for name, tensor in self.best_state.items()}
        for index, entry in self.optimiser.state_dict()["state"].items():
            tensors |= {
                f"optimiser.{index}.{key}": value.cpu().contiguous() for key, value in entry.items()
            }
        record = {"identity": self.identity, "step": self.step, "best": self.best}
        write_jsonl(folder / "steps.jsonl", self.rows)
        # Step and tensors in one file: a kill between two files could not be told from a whole checkpoint.
        write_bytes(folder / CHECKPOINT, save(tensors, metadata={"run": json.dumps(record)}))

    def resume(self, folder: Path) -> None:
        path = folder / CHECKPOINT
        if not path.exists():
            refuse_foreign(folder, {"steps.jsonl"})
            return
        try:
            with safe_open(path, framework="pt") as file:
                record = json.loads(file.metadata()["run"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
            _same_training(record["identity"], self.identity, folder)
            self.detector.load_state_dict(_part(tensors, "weights."))
            self.averaged.load_state_dict(_part(tensors, "averaged."))
            state: dict[int, dict[str, Tensor]] = {}
            for name, tensor in _part(tensors, "optimiser.").items():
                index, key = name.split(".")
                state.setdefault(int(index), {})[key] = tensor
            groups = self.optimiser.state_dict()["param_groups"]
            self.optimiser.load_state_dict({"state": state, "param_groups": groups})
            self.best_state = _part(tensors, "best.")
            self.step, self.best = int(record["step"]), record["best"]
        except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
            raise StoredFileError(
                f"{path} is damaged ({error}); remove it and train again."
            ) from error
        self.rows = [row for row in read_jsonl(folder / "steps.jsonl") if row["step"] <= self.step]


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _learning_rate(step: int, settings: TrainingSettings) -> float:
    rise = max(1, round(settings.warm_up * settings.steps))
    if step < rise:
        return settings.learning_rate * (step + 1) / rise
    progress = (step - rise) / max(1, settings.steps - rise)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * progress))


def _check(training: Dataset, validation: Dataset) -> None:
    if not len(training) or not any(len(boxes) for boxes in training.boxes):
        raise ConfigurationError(
            "Training expects images with at least one vehicle; none was given."
        )
    check_validation(validation)
    if not math.isclose(training.gsd_m, validation.gsd_m):
        raise ConfigurationError(
            f"Training images have {training.gsd_m} m per pixel, validation images {validation.gsd_m}; resample one."
        )


def check_validation(validation: Dataset) -> None:
    """Refuses images that no threshold can be chosen on.

    Raises:
        ConfigurationError: no vehicle in them.
    """
    if not any(len(boxes) for boxes in validation.boxes):
        raise ConfigurationError(
            "Validation expects at least one vehicle: without one no threshold can be chosen."
        )


def _same_training(stored: Any, wanted: Any, folder: Path) -> None:
    if stored != json.loads(json.dumps(wanted)):
        raise RunFolderError(
            f"{folder} holds a training with other settings or another seed; choose another folder or remove it first."
        )


def _finished(detector: TrainableDetector, folder: Path, identity: dict[str, Any]) -> DetectorCard:
    stored = load_detector(folder)
    _same_training(stored.card.training.get("identity"), identity, folder)
    detector.load_state_dict(stored.detector.state_dict())
    detector.eval()
    return stored.card


def _finish(run: _Run, training: Dataset, folder: Path) -> DetectorCard:
    run.detector.load_state_dict(run.best_state)
    run.detector.eval()
    width, height = training.pictures[0].size_px
    card = DetectorCard(
        name=run.detector.name,
        size=run.detector.size,
        threshold=run.best["threshold"],
        gsd_m=training.gsd_m,
        image_size_px=(min(height, WINDOW_PX), min(width, WINDOW_PX)),
        parameters=sum(parameter.numel() for parameter in run.detector.parameters()),
        training={"identity": run.identity, "images": len(training), "best_step": run.best["step"]},
        validation={key: run.best[key] for key in ("ap_centre_1m", "ap_iou_50", "f1")},
        skyproof_version=installed_version(),
        trained_on=training.origin,
    )
    save_detector(folder, run.detector, card)
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return card
