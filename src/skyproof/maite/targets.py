"""The data that MAITE's components exchange: images, labelled boxes, and metadata of each image.

MAITE's protocols are structural, so nothing here imports the library.
"""

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
"""Our detectors and datasets have one class."""

Batch = tuple[Sequence[Any], Sequence[Any], Sequence[Mapping[str, Any]]]
"""Images, targets and metadata, as MAITE's data loaders yield them."""


@dataclass(frozen=True, eq=False)
class Target:
    """A MAITE object-detection target: the true vehicles of an image, or the detections in it.

    Attributes:
        boxes: `[N, 4]` pixel xyxy, half-open, origin at the top-left corner.
        labels: `[N]` zeros, the one class of `LABELS`.
        scores: `[N]` in [0, 1]; ones for true vehicles.
    """

    boxes: Float[np.ndarray, "N 4"]
    labels: np.ndarray
    scores: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, boxes: Float[Tensor, "N 4"], scores: Float[Tensor, " N"] | None = None) -> "Target":
        """Makes a target of vehicles; without scores they are true ones."""
        return cls(
            boxes=boxes.detach().cpu().numpy().astype(np.float32),
            labels=np.zeros(len(boxes), dtype=np.int64),
            scores=np.ones(len(boxes), dtype=np.float32)
            if scores is None
            else scores.detach().cpu().numpy().astype(np.float32),
        )


def batches(dataset: Any, size: int) -> Iterator[Batch]:
    """Reads a MAITE dataset batch by batch."""
    for start in range(0, len(dataset), size):
        data = [dataset[index] for index in range(start, min(start + size, len(dataset)))]
        images, targets, metadata = zip(*data, strict=True)
        yield list(images), list(targets), list(metadata)


def bytes_of(image: Any) -> UInt8[Tensor, "3 H W"]:
    """Reads a MAITE image, any array-like `[3, H, W]` of 0 to 255, or of fractions, as bytes.

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
    # NaN is neither below nor above the range, so the test is whether all values lie inside.
    if values.size and not (values.min() >= 0 and values.max() <= most):
        raise ConfigurationError(
            f"Images of {'whole numbers' if whole else 'floats'} are sRGB from 0 to {most} to "
            f"skyproof, got {values.min():.4g} to {values.max():.4g}; bring them into that range."
        )
    if whole:
        return torch.from_numpy(values.astype(np.uint8))
    return torch.from_numpy((values.astype(np.float32) * 255).round().astype(np.uint8))


def found_vehicles(target: Any, labels: Sequence[int]) -> Detections:
    """Reads a MAITE model's answer to one image: its possible vehicles, sorted by falling score.

    Scores are `[N]` or `[N, classes]`. Those of several classes exclude each other, because MAITE
    lets them sum to at most 1, so the scores of all vehicle classes (`labels`) are added up.

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
    # Boxes that are surely no vehicle go; NaN stays, so that a later check notices it.
    kept = ~(likely <= 0)
    order = np.argsort(-likely[kept], kind="stable")
    # MAITE allows sums to exceed 1 by rounding.
    certain = np.where(likely[kept] < 1 + 1e-6, np.minimum(likely[kept], 1), likely[kept])
    return Detections(
        torch.from_numpy(boxes[kept][order]),
        torch.from_numpy(certain[order].astype(np.float32)),
    )
