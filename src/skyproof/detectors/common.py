"""Shared parts of all detectors: checks of their input, padding to a stride, and targets."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from skyproof.errors import ConfigurationError

SMALLEST_IMAGE_PX = 96
PADDING_GREY = 0.45


def check_images(images: Tensor) -> None:
    """Refuses images that no detector here can read."""
    if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[-2:]) < SMALLEST_IMAGE_PX:
        raise ConfigurationError(
            "A detector expects images [B, 3, H, W] with H and W of at least "
            f"{SMALLEST_IMAGE_PX} px, but got {list(images.shape)}; use larger tiles."
        )


def check_targets(images: Tensor, targets: Sequence[Tensor]) -> None:
    """Refuses targets without one box tensor per image."""
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
    """Boxes as a torchvision target: class 1 is the vehicle, 0 the background."""
    return {
        "boxes": boxes,
        "labels": torch.ones(len(boxes), dtype=torch.int64, device=boxes.device),
    }
