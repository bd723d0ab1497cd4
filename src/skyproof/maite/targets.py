"""What MAITE's components hand to each other: images, boxes with labels, and words on each image.

MAITE's protocols are structural, so nothing here imports the library.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.detectors.detector import Detections
from skyproof.errors import ConfigurationError

LABELS = {0: "vehicle"}
"""Our detectors and datasets know one class."""

Batch = tuple[Sequence[Any], Sequence[Any], Sequence[Mapping[str, Any]]]
"""Images, targets and metadata, as MAITE's data loaders yield them."""


@dataclass(frozen=True, eq=False)
class Target:
    """A MAITE object-detection target: true vehicles of an image, or those that were found in it.

    Attributes:
        boxes: `[N, 4]` pixel xyxy, half-open, origin at the top-left corner.
        labels: `[N]` zeros, the one class of `LABELS`.
        scores: `[N]` in [0, 1]; ones where the vehicles are true.
    """

    boxes: Float[np.ndarray, "N 4"]
    labels: np.ndarray
    scores: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, boxes: Float[Tensor, "N 4"], scores: Float[Tensor, " N"] | None = None) -> Target:
        """Makes a target of vehicles; true ones where no scores are given."""
        return cls(
            boxes=boxes.detach().cpu().numpy().astype(np.float32),
            labels=np.zeros(len(boxes), dtype=np.int64),
            scores=np.ones(len(boxes), dtype=np.float32)
            if scores is None
            else scores.detach().cpu().numpy().astype(np.float32),
        )


def batches(dataset: Any, size: int) -> Iterator[Batch]:
    """Reads a MAITE dataset, some images at a time."""
    for start in range(0, len(dataset), size):
        data = [dataset[index] for index in range(start, min(start + size, len(dataset)))]
        images, targets, metadata = zip(*data, strict=True)
        yield list(images), list(targets), list(metadata)


def bytes_of(image: Any) -> UInt8[Tensor, "3 H W"]:
    """Reads a MAITE image as sRGB bytes.

    MAITE prescribes no range of values: whole numbers are taken for 0 to 255, others for 0 to 1.

    Args:
        image: `[3, H, W]`, anything that NumPy makes an array of.

    Raises:
        ConfigurationError: it has another shape, or values outside that range.
    """
    values = np.asarray(image)
    if values.ndim != 3 or values.shape[0] != 3:
        raise ConfigurationError(
            f"An image is [3, height, width] to skyproof, got {list(values.shape)}; give RGB "
            "images, channels first."
        )
    whole = np.issubdtype(values.dtype, np.integer)
    most = 255 if whole else 1
    # Not a number is neither below nor above, so it is asked whether all lie inside.
    if values.size and not (values.min() >= 0 and values.max() <= most):
        raise ConfigurationError(
            f"Images of {'whole numbers' if whole else 'floats'} are sRGB from 0 to {most} to "
            f"skyproof, got {values.min():.4g} to {values.max():.4g}; bring them into that range."
        )
    if whole:
        return torch.from_numpy(values.astype(np.uint8))
    return torch.from_numpy((values.astype(np.float32) * 255).round().astype(np.uint8))


def found_vehicles(target: Any, labels: Sequence[int]) -> Detections:
    """Reads a MAITE model's answer to one image.

    Scores of several classes are probabilities that exclude each other, as MAITE's own rule that
    they sum to at most 1 says; those of all vehicle classes are added up.

    Args:
        target: boxes `[N, 4]`, labels `[N]`, scores `[N]` or `[N, classes]`.
        labels: of the classes that are vehicles.

    Returns:
        What may be a vehicle, sorted by falling score.

    Raises:
        ValueError: the answer has another shape.
    """
    boxes = np.asarray(target.boxes, dtype=np.float32).reshape(-1, 4)
    scores = np.asarray(target.scores, dtype=np.float32)
    if not len(boxes):
        return Detections(torch.zeros(0, 4), torch.zeros(0))
    if scores.ndim == 2:
        likely = scores[:, list(labels)].sum(1)
    else:
        likely = np.where(np.isin(np.asarray(target.labels), labels), scores, 0)
    if likely.shape != (len(boxes),):
        raise ValueError(f"{len(boxes)} boxes with scores of shape {list(scores.shape)}")
    # What is surely no vehicle goes; what is not a number stays, to be noticed.
    kept = ~(likely <= 0)
    order = np.argsort(-likely[kept], kind="stable")
    # MAITE lets sums exceed 1 by rounding.
    certain = np.where(likely[kept] < 1 + 1e-6, np.minimum(likely[kept], 1), likely[kept])
    return Detections(
        torch.from_numpy(boxes[kept][order]),
        torch.from_numpy(certain[order].astype(np.float32)),
    )
