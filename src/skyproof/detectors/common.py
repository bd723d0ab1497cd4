"""What detectors share: padding to a stride, suppression, and the cut at the lowest score."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torchvision import ops

from skyproof.detectors.detector import Candidates, Detections
from skyproof.errors import ConfigurationError

__all__ = [
    "LOWEST_SCORE",
    "MOST_DETECTIONS",
    "PADDING_GREY",
    "SMALLEST_IMAGE_PX",
    "as_targets",
    "check_images",
    "check_targets",
    "pad_to_stride",
    "suppress",
]

LOWEST_SCORE = 0.01
MOST_DETECTIONS = 100
SMALLEST_IMAGE_PX = 96
PADDING_GREY = 0.45
SUPPRESSION_IOU = 0.5
# As in torchvision: an attacked image may have many thousand candidates above the lowest score.
MOST_CANDIDATES = 1000


def check_images(images: Tensor) -> None:
    """Refuses what no detector here can read.

    Raises:
        ConfigurationError: not `[B, 3, H, W]` with H and W at least 96 px.
    """
    if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[-2:]) < SMALLEST_IMAGE_PX:
        raise ConfigurationError(
            "A detector expects images [B, 3, H, W] with H and W of at least "
            f"{SMALLEST_IMAGE_PX} px, but got {list(images.shape)}; use larger tiles."
        )


def check_targets(images: Tensor, targets: Sequence[Tensor]) -> None:
    """Refuses a loss whose truth does not belong to its images.

    Raises:
        ConfigurationError: one box tensor per image is expected.
    """
    if len(targets) != len(images):
        raise ConfigurationError(
            f"A loss expects one tensor of boxes per image, but got {len(targets)} for "
            f"{len(images)}."
        )


def pad_to_stride(
    images: Float[Tensor, "B 3 H W"], value: float, stride_px: int = 32
) -> Float[Tensor, "B 3 H2 W2"]:
    """Pads right and below until both sides are multiples of `stride_px`; coordinates stay."""
    height, width = images.shape[-2:]
    return functional.pad(images, (0, -width % stride_px, 0, -height % stride_px), value=value)


def suppress(candidates: Candidates, height_px: int, width_px: int) -> list[Detections]:
    """Makes detections of candidates.

    Those of a score >= 0.01 are clipped to the image, of the best 1000 duplicates are suppressed at
    an IoU of 0.5, and at most 100 are left, sorted by falling score.

    Args:
        candidates: before threshold and suppression.
        height_px, width_px: size of the images before padding.
    """
    found = []
    for boxes, scores, valid in zip(
        candidates.boxes, candidates.scores, candidates.valid, strict=True
    ):
        clipped = ops.clip_boxes_to_image(boxes, (height_px, width_px))
        sides = clipped[:, 2:] - clipped[:, :2]
        keep = valid & (scores >= LOWEST_SCORE) & (sides > 0.5).all(dim=1)
        kept_scores, order = scores[keep].sort(descending=True, stable=True)
        kept_scores, kept_boxes = (
            kept_scores[:MOST_CANDIDATES],
            clipped[keep][order[:MOST_CANDIDATES]],
        )
        best = ops.nms(kept_boxes, kept_scores, SUPPRESSION_IOU)[:MOST_DETECTIONS]
        found.append(Detections(kept_boxes[best].detach(), kept_scores[best].detach().clamp(0, 1)))
    return found


def as_targets(boxes: Tensor) -> dict[str, Tensor]:
    """Boxes as torchvision wants a target: class 1 is the vehicle where 0 is background."""
    return {
        "boxes": boxes,
        "labels": torch.ones(len(boxes), dtype=torch.int64, device=boxes.device),
    }
