"""Textures as the light that they reflect, read at the size that a sample spans."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.materials import reflectance
from skyproof.vehicles.vehicle import Overlay

__all__ = ["LinearTexture"]


class LinearTexture:
    """What textures reflect, as a pyramid of halved sizes, read at the level that fits.

    A sample that spans several texels must read their mean: that is what keeps a fine pattern, or a
    side seen at a grazing angle, from turning into sparkle, and its gradient into noise.

    Args:
        texture: `[T, 3, H, W]` sRGB, as bytes or in [0, 1]; sides are powers of two.
        finest: the first level worth building; the full map is level 0.
        overlay: lies on top of `texture`.
    """

    levels = 7

    def __init__(
        self,
        texture: Float[Tensor, "T 3 H W"] | UInt8[Tensor, "T 3 H W"],
        finest: int = 0,
        dtype: torch.dtype = torch.float32,
        overlay: Overlay | None = None,
    ) -> None:
        self.finest = min(finest, self.levels - 1)
        level = (
            _linear(texture, dtype, self.finest)
            if overlay is None
            else _covered(texture, overlay, self.finest)
        )
        level = reflectance(level)
        self.count = len(level)
        self.height, self.width = texture.shape[2:]
        texels, offsets = [], [0]
        for index in range(self.levels):
            if index >= self.finest:
                texels.append(level.transpose(0, 1).reshape(3, -1))
                offsets.append(offsets[-1] + texels[-1].shape[1])
                level = _halve(level)
        self._texels = torch.cat(texels, dim=1)
        self._offsets = torch.tensor(offsets[:-1], device=texture.device)

    def sample(
        self, uv: Float[Tensor, "2 K"], index: Int[Tensor, " K"], level: Int[Tensor, " K"]
    ) -> Float[Tensor, "3 K"]:
        """Returns bilinear values at (u, v) of the textures `index` (section S4.3).

        They are circular in u and held at the edge in v.
        """
        level = level.clamp(self.finest, self.levels - 1)
        width, height = self.width >> level, self.height >> level
        base = self._offsets.index_select(0, level - self.finest)
        if self.count > 1:
            base = base + index * height * width
        x, y = uv[0] * width - 0.5, uv[1] * height - 0.5
        left = x.detach().floor()
        top = y.detach().floor()
        across, down = x - left, y - top
        left = left.long()
        top = top.long()
        # Sides are powers of two, of which this is the remainder.
        columns = [left & (width - 1), (left + 1) & (width - 1)]
        rows = [base + top.clamp(min=0).minimum(height - 1) * width]
        rows += [base + (top + 1).clamp(min=0).minimum(height - 1) * width]
        # Look-ups along a dimension, whose backward pass is a plain sum, are faster than indexing.
        upper, lower = (
            torch.lerp(
                self._texels.index_select(1, row + columns[0]),
                self._texels.index_select(1, row + columns[1]),
                across,
            )
            for row in rows
        )
        return torch.lerp(upper, lower, down)


def _linear(texture: Tensor, dtype: torch.dtype, finest: int) -> Tensor:
    """Linear light, already reduced to level `finest`."""
    if texture.dtype != torch.uint8:
        return _reduced(srgb_to_linear(texture), finest)
    # One vehicle at a time: the full maps of a batch together would fall out of every cache.
    return torch.stack([_reduced(_bytes_to_linear(vehicle, dtype), finest) for vehicle in texture])


def _bytes_to_linear(texture: UInt8[Tensor, "3 H W"], dtype: torch.dtype) -> Float[Tensor, "3 H W"]:
    table = srgb_to_linear(torch.arange(256, device=texture.device, dtype=dtype) / 255)
    # NumPy's table look-up is several times faster than indexing here.
    on_cpu = texture.device.type == "cpu"
    return (
        torch.from_numpy(np.take(table.numpy(), texture.numpy()))
        if on_cpu
        else table[texture.int()]
    )


def _reduced(level: Tensor, finest: int) -> Tensor:
    for _ in range(finest):
        level = _halve(level)
    return level


def _covered(texture: Tensor, overlay: Overlay, finest: int) -> Float[Tensor, "N 3 h w"]:
    """Level `finest` of the textures under an overlay; the gradient reaches the overlay alone."""
    return _Covered.apply(srgb_to_linear(overlay.texture), overlay.mask, texture.detach(), finest)


class _Covered(torch.autograd.Function):
    """Works on one vehicle at a time, because a batch of full maps falls out of every cache."""

    @staticmethod
    def forward(context: Any, cover: Tensor, masks: Tensor, own: Tensor, finest: int) -> Tensor:
        context.save_for_backward(masks)
        context.finest = finest
        reduced = []
        for index, mask in enumerate(masks):
            below = own[index if len(own) > 1 else 0]
            below = (
                _bytes_to_linear(below, cover.dtype)
                if below.dtype == torch.uint8
                else srgb_to_linear(below)
            )
            reduced.append(_reduced(torch.where(mask, cover, below), finest))
        return torch.stack(reduced)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (masks,) = context.saved_tensors
        side = 2**context.finest
        _, channels, height, width = gradients[0].shape
        total = gradients[0].new_zeros(channels, height, side, width, side)
        for mask, gradient in zip(masks, gradients[0] / side**2, strict=True):
            total.addcmul_(
                gradient[:, :, None, :, None], mask.view(height, side, width, side).to(total.dtype)
            )
        return total.view(channels, height * side, width * side), None, None, None


def _halve(level: Tensor) -> Tensor:
    return _Halve.apply(level)


class _Halve(torch.autograd.Function):
    """Takes means of 2 x 2.

    Strided sums beat average pooling on a CPU, but each slice's own gradient would fill a map.
    """

    @staticmethod
    def forward(context: Any, level: Tensor) -> Tensor:
        even, odd = level[..., ::2, :], level[..., 1::2, :]
        return (even[..., ::2] + even[..., 1::2] + odd[..., ::2] + odd[..., 1::2]).mul_(0.25)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        quarter = gradients[0] * 0.25
        *others, height, width = quarter.shape
        return (
            quarter[..., None, :, None]
            .expand(*others, height, 2, width, 2)
            .reshape(*others, 2 * height, 2 * width)
        )
