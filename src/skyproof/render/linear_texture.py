"""Textures as the light that they reflect, read at the size that a sample spans."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.materials import reflectance
from skyproof.vehicles.vehicle import Overlay


class LinearTexture:
    """The reflectance of textures, as a pyramid of halved sizes, read at the fitting level.

    A sample that spans several texels reads their mean, so that fine patterns neither sparkle nor
    give noisy gradients.

    Args:
        texture: `[T, 3, H, W]` sRGB, as bytes or in [0, 1]; sides are powers of two.
        finest: first level that is read; the full map is level 0.
    """

    levels = 7

    def __init__(
        self,
        texture: Float[Tensor, "T 3 H W"] | UInt8[Tensor, "T 3 H W"],
        finest: int = 0,
        dtype: torch.dtype = torch.float32,
        overlay: Overlay | None = None,
    ) -> None:
        height, width = texture.shape[2:]
        if overlay is None:
            count = len(texture)
            (own, shown) = (texture, None) if texture.dtype == torch.uint8 else (None, texture)
            mask = None
        else:
            count = len(overlay.mask)
            own, shown, mask = texture.detach(), overlay.texture, overlay.mask
        shapes = _Shapes(count, height, width, min(finest, self.levels - 1), self.levels)
        reflected = None if shown is None else reflectance(srgb_to_linear(shown))
        self._texels = _Pyramid.apply(reflected, mask, own, shapes, dtype)
        self._shapes = shapes
        self._offsets = torch.tensor(shapes.offsets[:-1], device=texture.device)

    def sample(
        self, uv: Float[Tensor, "2 K"], index: Int[Tensor, " K"], level: Int[Tensor, " K"]
    ) -> Float[Tensor, "3 K"]:
        """Bilinear values at (u, v) of the textures `index` (S4.3), circular in u, held in v."""
        shapes = self._shapes
        level = level.clamp(shapes.finest, shapes.levels - 1)
        width, height = shapes.width >> level, shapes.height >> level
        base = self._offsets.index_select(0, level - shapes.finest)
        if shapes.count > 1:
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


@dataclass(frozen=True)
class _Shapes:
    """Where a pyramid's levels lie in one row of texels, level after level, texture by texture."""

    count: int
    height: int
    width: int
    finest: int
    levels: int

    @cached_property
    def offsets(self) -> list[int]:
        """Where each level from `finest` on begins, and where the last ends."""
        sizes = [
            self.count * (self.height >> level) * (self.width >> level)
            for level in range(self.finest, self.levels)
        ]
        return [0, *itertools.accumulate(sizes)]

    def views(self, texels: Tensor, textures: slice) -> list[Float[Tensor, "3 T h w"]]:
        """Each level of some of the textures, as a view of all texels."""
        views = []
        for level, start, end in zip(
            range(self.finest, self.levels), self.offsets, self.offsets[1:], strict=False
        ):
            shape = (3, self.count, self.height >> level, self.width >> level)
            views.append(texels[:, start:end].view(shape)[:, textures])
        return views

    def some(self, device: torch.device) -> list[slice]:
        """The textures to work on at a time: one by one on a CPU, whose caches full maps exceed."""
        step = 1 if device.type == "cpu" else self.count
        return [slice(start, start + step) for start in range(0, self.count, step)]


class _Pyramid(torch.autograd.Function):
    """All levels in one piece of memory; the gradient reaches the shown texture, under its mask."""

    @staticmethod
    def forward(
        context: Any,
        shown: Float[Tensor, "*T 3 H W"] | None,
        masks: Bool[Tensor, "T H W"] | None,
        own: Tensor | None,
        shapes: _Shapes,
        dtype: torch.dtype,
    ) -> Float[Tensor, "3 K"]:
        if shown is not None:
            dtype = shown.dtype
        device = next(each for each in (shown, own) if each is not None).device
        context.save_for_backward(masks)
        context.shapes = shapes
        texels = torch.empty(3, shapes.offsets[-1], dtype=dtype, device=device)
        # Where the full maps are none of the levels, they are made here, again and again.
        aside = None
        for some in shapes.some(device):
            views = shapes.views(texels, some)
            if shapes.finest:
                if aside is None:
                    aside = texels.new_empty(3, views[0].shape[1], shapes.height, shapes.width)
                level, coarser = aside, views
            else:
                level, coarser = views[0], views[1:]
            _fill(level, shown, masks, own, some)
            for _ in range(shapes.finest - 1):
                level = _halve(level)
            for view in coarser:
                level = _halve(level, view)
        return texels

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (masks,) = context.saved_tensors
        shapes: _Shapes = context.shapes
        side = 2**shapes.finest
        height, width = shapes.height // side, shapes.width // side
        shape = (3, height, side, width, side)
        parts = []
        total = gradients[0].new_zeros(shape)
        for some in shapes.some(total.device):
            # From the coarsest level on: a texel hands each of the four under it a quarter.
            gradient = None
            for view in reversed(shapes.views(gradients[0], some)):
                level = view.clone()
                if gradient is not None:
                    _, count, rows, columns = gradient.shape
                    under = level.view(3, count, rows, 2, columns, 2)
                    under.add_(gradient[:, :, :, None, :, None], alpha=0.25)
                gradient = level
            assert gradient is not None
            # And on to the full maps, of which only what shows has a gradient.
            full = (gradient / side**2)[:, :, :, None, :, None]
            if masks is None:
                parts.append(full.expand(-1, -1, *shape[1:]))
            else:
                for index, mask in enumerate(masks[some]):
                    total.addcmul_(full[:, index], mask.view(shape[1:]).to(total.dtype))
        if masks is None:
            everything = torch.cat(parts, dim=1).transpose(0, 1)
            total = everything.reshape(shapes.count, 3, shapes.height, shapes.width)
        else:
            total = total.view(3, shapes.height, shapes.width)
        return total, None, None, None, None


def _fill(
    level: Float[Tensor, "3 T H W"],
    shown: Tensor | None,
    masks: Tensor | None,
    own: Tensor | None,
    some: slice,
) -> None:
    """Fills the full maps of some textures with what they reflect."""
    if own is None:
        assert shown is not None
        level.copy_(shown[some].transpose(0, 1))
        return
    below = own[some] if len(own) > 1 else own
    if below.dtype != torch.uint8:
        level.copy_(reflectance(srgb_to_linear(below)).transpose(0, 1))
    else:
        table = _of_bytes(level.dtype, level.device)
        if level.device.type == "cpu":
            # NumPy's table look-up is several times faster than indexing here.
            for channel, of_bytes in zip(level.unbind(0), below.unbind(1), strict=True):
                np.take(table.numpy(), of_bytes.numpy(), out=channel.numpy(), mode="clip")
        else:
            level.copy_(table[below.int()].transpose(0, 1))
    if shown is not None:
        assert masks is not None
        torch.where(masks[some], shown[:, None], level, out=level)


@cache
def _of_bytes(dtype: torch.dtype, device: torch.device) -> Float[Tensor, 256]:
    """What each sRGB byte reflects."""
    return reflectance(srgb_to_linear(torch.arange(256, dtype=dtype, device=device) / 255))


def _halve(level: Tensor, out: Tensor | None = None) -> Tensor:
    """Takes means of 2 x 2; on a CPU these sums beat average pooling."""
    rows = level[..., ::2, :] + level[..., 1::2, :]
    return torch.add(rows[..., ::2], rows[..., 1::2], out=out).mul_(0.25)
