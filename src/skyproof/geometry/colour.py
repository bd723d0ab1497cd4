"""sRGB (IEC 61966-2-1) for storage, linear light for sums, CIELAB for perceived differences."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

# Linear sRGB to CIE XYZ (IEC 61966-2-1), and its white point D65.
_TO_XYZ = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
_WHITE = (0.95047, 1.0, 1.08883)
_KNEE = 6 / 29


def srgb_to_linear(srgb: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Converts sRGB in [0, 1] to linear light in [0, 1]."""
    return _SrgbToLinear.apply(srgb)


class _SrgbToLinear(torch.autograd.Function):
    """Takes the derivative of large textures from the result, without another power."""

    @staticmethod
    def forward(context: Any, srgb: Tensor) -> Tensor:
        # exp and log take a third of the time of a power.
        curve = srgb.clamp(min=0.0).add_(0.055).mul_(1 / 1.055).log_().mul_(2.4).exp_()
        linear = torch.where(srgb <= 0.04045, srgb / 12.92, curve)
        context.save_for_backward(srgb, linear)
        return linear

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        srgb, linear = context.saved_tensors
        steep = torch.where(srgb <= 0.04045, 1 / 12.92, 2.4 * linear / (srgb + 0.055))
        return steep.mul_(gradients[0])


def linear_to_srgb(linear: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Converts linear light to sRGB, clipped to [0, 1] as a camera's converter does."""
    linear = linear.clamp(0.0, 1.0)
    # The inner clamp keeps the power's gradient finite at black.
    root = torch.exp(linear.clamp(min=0.0031308).log() * (1 / 2.4))
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * root - 0.055)


def srgb_to_cielab(srgb: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S 3"]:
    """Converts sRGB in [0, 1] to CIE 1976 L* a* b* under D65 (CIE 15:2004); L* in [0, 100]."""
    xyz = srgb_to_linear(srgb) @ srgb.new_tensor(_TO_XYZ).T / srgb.new_tensor(_WHITE)
    x, y, z = torch.where(
        xyz > _KNEE**3, xyz.clamp(min=0.0) ** (1 / 3), xyz / (3 * _KNEE**2) + 4 / 29
    ).unbind(-1)
    return torch.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), dim=-1)


def cielab_to_srgb(cielab: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S 3"]:
    """The inverse of `srgb_to_cielab`; colours outside sRGB are clipped."""
    lightness, a, b = cielab.unbind(-1)
    y = (lightness + 16) / 116
    roots = torch.stack((y + a / 500, y, y - b / 200), dim=-1)
    shares = torch.where(roots > _KNEE, roots**3, 3 * _KNEE**2 * (roots - 4 / 29))
    xyz = shares * cielab.new_tensor(_WHITE)
    return linear_to_srgb(xyz @ torch.linalg.inv(cielab.new_tensor(_TO_XYZ)).T)
