"""Between sRGB, in which images and textures are stored, and linear light, in which light adds up (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["linear_to_srgb", "srgb_to_linear"]


def srgb_to_linear(srgb: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """sRGB in [0, 1] to linear light in [0, 1]."""
    return _SrgbToLinear.apply(srgb)


class _SrgbToLinear(torch.autograd.Function):
    """The derivative follows from the result without another power: textures are large, and converted at every step."""

    @staticmethod
    def forward(context: Any, srgb: Tensor) -> Tensor:
        curve = srgb.clamp(min=0.0).add_(0.055).mul_(1 / 1.055).pow_(2.4)
        linear = torch.where(srgb <= 0.04045, srgb / 12.92, curve)
        context.save_for_backward(srgb, linear)
        return linear

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        srgb, linear = context.saved_tensors
        steep = torch.where(srgb <= 0.04045, 1 / 12.92, 2.4 * linear / (srgb + 0.055))
        return steep.mul_(gradients[0])


def linear_to_srgb(linear: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Linear light to sRGB; values outside [0, 1] are clipped, as a camera's converter does."""
    linear = linear.clamp(0.0, 1.0)
    # The inner clamp keeps the power's gradient finite at black.
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)
