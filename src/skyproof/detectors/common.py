"""What detectors share: checks of what they are given, padding to a stride, and targets."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from skyproof.errors import ConfigurationError

SMALLEST_IMAGE_PX = 96
PADDING_GREY = 0.45


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


def as_targets(boxes: Tensor) -> dict[str, Tensor]:
    """Boxes as torchvision wants a target: class 1 is the vehicle where 0 is background."""
    return {
        "boxes": boxes,
        "labels": torch.ones(len(boxes), dtype=torch.int64, device=boxes.device),
    }
