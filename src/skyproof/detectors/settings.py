"""Training settings of detectors. Imports no torch, so that the command line answers at once."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, get_args, get_type_hints

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.ranges import Checked, Count, Fraction

# Sizes of our own networks, for CPU and GPU.
Size = Literal["slim", "full"]
SIZES: tuple[Size, ...] = get_args(Size)
DETECTOR_NAMES = ("retinanet", "faster_rcnn", "yolov5")


@dataclass(frozen=True)
class TrainingSettings(Checked):
    """How long and how fast a detector is trained.

    Attributes:
        steps: number of optimiser steps; a slim detector takes 600 (RetinaNet 800) and a full one
            10,000 if none are given.
        batch_size: images per step.
        learning_rate: peak learning rate; it rises linearly over the first `warm_up` of the steps,
            then falls to 0 by half a cosine.
        weight_decay: AdamW's weight decay, on matrices and kernels only.
        warm_up: fraction of the steps in which the learning rate rises.
        largest_gradient_norm: limit to which larger gradients are scaled down.
        average_decay: decay of the running average of the weights, which is validated and stored.
        jitter: strength of the photometric augmentation; 0 is none, 1 is mild.
        validate_every: steps between validations; the last step is always validated.
        checkpoint_every: steps between checkpoints.
    """

    steps: Count = 1000
    batch_size: Suppress[Annotated[int, Meta(ge=1, le=4096)]] = 16
    learning_rate: Suppress[Annotated[float, Meta(gt=0, le=10)]] = 2e-3
    weight_decay: Suppress[Annotated[float, Meta(ge=0, le=10)]] = 0.02
    warm_up: Suppress[Fraction] = 0.1
    largest_gradient_norm: Suppress[Annotated[float, Meta(gt=0, le=1e6)]] = 10.0
    average_decay: Suppress[Annotated[float, Meta(ge=0, lt=1)]] = 0.99
    jitter: Suppress[Annotated[float, Meta(ge=0, le=10)]] = 1.0
    validate_every: Suppress[Count] = 250
    checkpoint_every: Suppress[Count] = 100


if TYPE_CHECKING:
    TrainingChanges = dict[str, Any]
else:
    # The same fields, all optional: the differences from a preset.
    _FIELDS = get_type_hints(TrainingSettings, include_extras=True)
    TrainingChanges = TypedDict("TrainingChanges", _FIELDS, total=False)
    TrainingChanges.__doc__ = TrainingSettings.__doc__

# 2,000 synthetic tiles of 192 px, one thread: 600 steps take 100 to 120 CPU-seconds, for a centre
# AP of 0.96 to 0.98.
_CPU = TrainingSettings(steps=600, batch_size=8, validate_every=200)
# The paper trains 10,000 iterations with batch 640 or 128 (its appendix on training details); it
# gives no learning rates.
_GPU = TrainingSettings(
    steps=10_000,
    batch_size=64,
    learning_rate=5e-4,
    weight_decay=0.05,
    average_decay=0.999,
    validate_every=1000,
    checkpoint_every=500,
)
TRAINING_PRESETS: dict[tuple[str, str], TrainingSettings] = {
    (name, size): settings
    for size, settings in (("slim", _CPU), ("full", _GPU))
    for name in DETECTOR_NAMES
}
# Focal loss starts slowly: it needs 800 steps for the result of the others after 600.
TRAINING_PRESETS["retinanet", "slim"] = replace(_CPU, steps=800)
