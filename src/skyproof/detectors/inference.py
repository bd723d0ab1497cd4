"""A detector over many images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from skyproof.detectors.detector import Detections, Detector

__all__ = ["detect_all"]


def detect_all(
    detector: Detector, images: Sequence[Tensor], *, batch_size: int = 16
) -> list[Detections]:
    """Runs `detect` over images of bytes, in batches of equal size, on the detector's own device."""
    parameter = next(detector.parameters(), None) if isinstance(detector, nn.Module) else None
    device = parameter.device if parameter is not None else torch.device("cpu")
    found: list[Detections] = []
    start = 0
    while start < len(images):
        stop = start + 1
        while (
            stop < len(images)
            and stop - start < batch_size
            and images[stop].shape == images[start].shape
        ):
            stop += 1
        batch = (
            torch.stack([images[index] for index in range(start, stop)]).to(device).float() / 255
        )
        found.extend(detector.detect(batch.contiguous(memory_format=torch.channels_last)))
        start = stop
    return found
