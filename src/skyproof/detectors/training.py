"""Trains a detector, from scratch or further, in a loop that survives a kill (section S1.1)."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from skyproof import __version__
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import made_ahead
from skyproof.detectors.batches import DrawnImages, training_batches
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import WINDOW_PX, TrainableDetector
from skyproof.detectors.inference import device_of
from skyproof.detectors.loaded import load_detector, save_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.validation import check_validation, validate
from skyproof.errors import ConfigurationError, NotFiniteError
from skyproof.files import alone
from skyproof.loop import Loop, LoopPart, refuse_other

_Tensors = tuple[Tensor, ...] | list[Tensor]

_OTHER = "a training with other settings, another seed, start or images"
_MOST_AP_LOST = 0.01


def train(
    detector: TrainableDetector,
    training: Dataset | None,
    validation: Dataset,
    settings: TrainingSettings,
    folder: Path,
    *,
    generator: torch.Generator,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    parent: DetectorCard | None = None,
    trained_on: str = "",
    drawn: DrawnImages | None = None,
) -> DetectorCard:
    """Trains `detector` in place; its best averaged weights end in it and in `folder`.

    A finished folder is loaded and not trained again. An unfinished one continues from its
    checkpoint with the same order of images and the same augmentation; on a CPU with the same
    number of threads the result equals that of an uninterrupted training bit for bit.

    The detector is on the device to train on: new from `build_detector`, or trained before as the
    card of its `parent` says. Half of the images are `drawn` as they are needed, or all without
    other `training` images. `trained_on` names the images. Validation chooses the best weights
    (centre AP, then F1) and freezes the threshold. The generator gives one number, the seed of
    order and augmentation (`training_batch`). `on_step` gets each row of `steps.jsonl`.

    Raises:
        ConfigurationError: no training image, or no vehicle to validate with.
        NotFiniteError: loss, gradient or a weight is not finite; the last checkpoint stays.
        RunFolderError: the folder holds another training, or another process works there.
        StoredFileError: the checkpoint is damaged.
    """
    folder = Path(folder)
    seed = int(torch.randint(2**62, (1,), generator=generator))
    identity = {
        "name": detector.name,
        "size": detector.size,
        "seed": seed,
        "settings": asdict(settings),
        "data_sha256": None if training is None else training.digest,
        "validation_sha256": validation.digest,
    }
    if parent is not None:
        identity["parent_sha256"] = detector.weights_sha256
    if drawn is not None:
        identity["world_sha256"] = drawn.digest
    width, height = _check(training, validation, drawn)

    def lessons(steps: range, _: TrainableDetector) -> Iterator[Tensor]:
        make = partial(training_batches, training, drawn, settings, seed, device_of(detector))
        for batches in made_ahead(make, steps):
            yield add_gradients(detector, batches)

    card = DetectorCard(
        name=detector.name,
        size=detector.size,
        threshold=1.0,  # replaced at the end
        gsd_m=validation.gsd_m,
        image_size_px=(min(height, WINDOW_PX), min(width, WINDOW_PX)),
        parameters=sum(parameter.numel() for parameter in detector.parameters()),
        training={
            "identity": json.loads(json.dumps(identity)),
            "images": len(training or ()),
            "data_sha256": identity["data_sha256"],
            "validation_sha256": identity["validation_sha256"],
        },
        trained_on=trained_on or (training.origin if training is not None else ""),
    )
    return fit(detector.train(), validation, settings, folder, identity, lessons, card, on_step)


def fit(
    detector: TrainableDetector,
    validation: Dataset,
    settings: TrainingSettings,
    folder: Path,
    identity: dict[str, Any],
    lessons: Callable[[range, TrainableDetector], Iterator[Tensor]],
    card: DetectorCard,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    parts: Mapping[str, LoopPart] | None = None,
    *,
    shares: Sequence[float] = (),
) -> DetectorCard:
    """Runs the steps of a training as `train` describes; the detector stays in its mode.

    `lessons` gets the steps to run, counted from 0, and a detector with the averaged weights. It
    adds the gradients of each step and yields the mean loss. `card` gets threshold and scores of
    the best weights. `parts` are further objects that change from step to step. With `shares` the
    averaged weights are mixed with those before (`_mix`).
    """
    if (folder / "detector.json").exists():
        return _finished(detector, folder, identity)

    detector.to(memory_format=torch.channels_last)
    start = [parameter.detach().clone() for parameter in detector.parameters() if shares]
    averaged = _averaged(detector, settings)
    follower = cast(TrainableDetector, averaged.module)
    optimiser = _optimiser(detector, settings)
    schedule = LambdaLR(optimiser, lambda step: _learning_rate(step, settings))
    best = _Best()
    loop = Loop(
        folder,
        identity,
        settings.steps,
        settings.checkpoint_every,
        {
            "detector": detector,
            "averaged": averaged,
            "optimiser": optimiser,
            "schedule": schedule,
            "best": best,
            **(parts or {}),
        },
        other=_OTHER,
        remedy=f"remove {folder} and train again",
        on_row=on_step,
    )
    with alone(folder):
        # Another process may have finished it in the meantime.
        if (folder / "detector.json").exists():
            return _finished(detector, folder, identity)
        loop.resume()
        optimiser.zero_grad(set_to_none=True)
        for step, loss in zip(loop, lessons(range(loop.step, loop.steps), follower), strict=True):
            norm = nn.utils.clip_grad_norm_(detector.parameters(), settings.largest_gradient_norm)
            # One transfer for both, because each one waits for the GPU.
            if not torch.isfinite(loss + norm):
                raise NotFiniteError(
                    f"The training loss is {loss.item():g} and its gradient {float(norm):g} at "
                    f"step {step}; train again in another folder, with a lower learning rate "
                    f"than {settings.learning_rate:g}."
                )
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
            (rate, _) = schedule.get_last_lr()
            schedule.step()
            averaged.update_parameters(detector)
            loop.report({"kind": "step", "step": step, "loss": float(loss), "learning_rate": rate})
            if step % settings.validate_every == 0 or step == settings.steps:
                if shares and step == settings.steps:
                    scores = _mix(follower, start, validation, shares)
                else:
                    scores = validate(follower, validation)
                best.keep(follower, scores, step)
                loop.report({"kind": "validation", "step": step, **scores})
        detector.load_state_dict(best.weights)
        scores = best.scores
        made = replace(
            card,
            threshold=scores["threshold"],
            training={
                **card.training,
                "best_step": scores["step"],
                **{key: scores[key] for key in ("trained_share", "ap_lost") if key in scores},
            },
            validation={key: scores[key] for key in ("ap_centre_1m", "ap_iou_50", "f1")},
            validation_vehicles=sum(map(len, validation.boxes)),
            skyproof_version=__version__,
        )
        save_detector(folder, detector.eval(), made)
        loop.forget()
    return made


def add_gradients(
    detector: TrainableDetector, batches: Sequence[tuple[Tensor, Sequence[Tensor]]]
) -> Tensor:
    """Adds the gradients of the mean loss of all images in some batches; returns that loss."""
    device = next(detector.parameters()).device
    count = sum(len(images) for images, _ in batches)
    total = torch.zeros((), device=device)
    for images, targets in batches:
        shown = images.to(device).contiguous(memory_format=torch.channels_last)
        loss = detector.loss(shown, [boxes.to(device) for boxes in targets]).mean()
        loss = loss * (len(images) / count)
        loss.backward()
        total += loss.detach()
    return total


class _Best:
    """The best averaged weights so far, and their scores."""

    def __init__(self) -> None:
        self.scores: dict[str, float] = {}
        self.weights: dict[str, Tensor] = {}

    def keep(self, detector: nn.Module, scores: dict[str, float], step: int) -> None:
        # Centre AP is compared to 0.01 points; F1 decides between equals.
        def rank(values: dict[str, float]) -> tuple[float, float]:
            return round(values["ap_centre_1m"], 4), values["f1"]

        if not self.scores or rank(scores) >= rank(self.scores):
            self.scores = {**scores, "step": step}
            state = detector.state_dict()
            self.weights = {name: tensor.cpu().clone() for name, tensor in state.items()}

    def state_dict(self) -> dict[str, Any]:
        return {"scores": self.scores, "weights": self.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.scores = state_dict["scores"]
        self.weights = state_dict["weights"]


def _mix(
    detector: TrainableDetector,
    start: Sequence[Tensor],
    validation: Dataset,
    shares: Sequence[float],
) -> dict[str, float]:
    """Mixes the weights with those at the start, and validates the result.

    The share of the trained weights is the first of `shares` that loses at most a point of centre
    AP, else the last (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models"). It is the
    "trained_share" of the scores, beside the "ap_lost".
    """
    trained = [parameter.clone() for parameter in detector.parameters()]
    before, scores = 0.0, {}
    for share in (0.0, *shares):
        for mixed, first, last in zip(detector.parameters(), start, trained, strict=True):
            mixed.copy_(torch.lerp(first, last, share))
        scores = validate(detector, validation)
        if not share:
            before = scores["ap_centre_1m"]
        lost = before - scores["ap_centre_1m"]
        if share and lost <= _MOST_AP_LOST:
            break
    return {**scores, "trained_share": share, "ap_lost": lost}


def _optimiser(detector: nn.Module, settings: TrainingSettings) -> torch.optim.AdamW:
    """Makes AdamW with a learning rate of 1, to be scaled; biases and norms do not decay."""
    decayed = [parameter for parameter in detector.parameters() if parameter.ndim > 1]
    others = [parameter for parameter in detector.parameters() if parameter.ndim <= 1]
    groups = [
        {"params": decayed, "weight_decay": settings.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=1.0)


def _averaged(detector: nn.Module, settings: TrainingSettings) -> AveragedModel:
    """A copy of the detector whose weights and buffers follow its own as a moving average."""

    def follow(kept: _Tensors, current: _Tensors, count: Tensor | int) -> None:
        # Early on the average must forget the untrained weights quickly.
        decay = min(settings.average_decay, int(count) / (int(count) + 10))
        for kept_tensor, tensor in zip(kept, current, strict=True):
            if tensor.is_floating_point():
                kept_tensor.lerp_(tensor, 1 - decay)
            else:
                kept_tensor.copy_(tensor)

    averaged = AveragedModel(detector, multi_avg_fn=follow, use_buffers=True)
    # With a count of 0, the average would begin as a copy of the weights after the first step.
    averaged.n_averaged.fill_(1)
    return averaged.eval().requires_grad_(False)


def _learning_rate(step: int, settings: TrainingSettings) -> float:
    """The learning rate of a step, counted from 0: a linear rise, then half a cosine to 0."""
    rise = max(1, round(settings.warm_up * settings.steps))
    if step < rise:
        return settings.learning_rate * (step + 1) / rise
    progress = (step - rise) / max(1, settings.steps - rise)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * progress))


def _check(
    training: Dataset | None, validation: Dataset, drawn: DrawnImages | None
) -> tuple[int, int]:
    """Refuses images that cannot train a detector; returns width and height of the first."""
    first = drawn if training is None else next(iter(training.pictures), None)
    vehicles = drawn is not None or (training is not None and any(map(len, training.boxes)))
    if first is None or not vehicles:
        raise ConfigurationError(
            "Training expects images with at least one vehicle; none was given."
        )
    check_validation(validation)
    for images in (training, drawn):
        if images is not None and not math.isclose(images.gsd_m, validation.gsd_m):
            raise ConfigurationError(
                f"Training images have {images.gsd_m} m per pixel, validation images "
                f"{validation.gsd_m}; resample one."
            )
    return first.size_px


def _finished(detector: TrainableDetector, folder: Path, identity: dict[str, Any]) -> DetectorCard:
    stored = load_detector(folder)
    refuse_other(folder, stored.card.training.get("identity"), identity, _OTHER)
    detector.load_state_dict(stored.state_dict())
    detector.eval()
    return stored.card
