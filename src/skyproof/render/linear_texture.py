"""Textures as the light that they reflect, read at the size that a sample spans."""

from functools import cache
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from skyproof.geometry.colour import srgb_to_linear
from skyproof.kernels import rows, struct
from skyproof.render.kernels.texture import LEVELS, TABLE, Cloth, Pyramid, fill, fill_back
from skyproof.render.materials import reflectance


class LinearTexture:
    """The reflectance of textures, as a pyramid of halved sizes, read at the fitting level.

    A sample that spans several texels reads their mean, so that fine patterns neither sparkle nor
    give noisy gradients. `texels` hold all levels of `pyramid`, the kernels' view of them.

    Args:
        shown: sRGB, as bytes or in [0, 1]; sides are powers of two. Under `masks` one texture for
            all vehicles.
        own: what is seen outside `masks`.
        finest: first level that is read; the full map is level 0.
    """

    def __init__(
        self,
        shown: Float[Tensor, "T 3 H H"] | UInt8[Tensor, "T 3 H H"],
        finest: int = 0,
        own: UInt8[Tensor, "_ 3 H H"] | None = None,
        masks: Bool[Tensor, "N H H"] | None = None,
    ) -> None:
        shown, device = shown.detach(), shown.device
        painted = shown.dtype != torch.uint8
        values: dict[str, Tensor] = {"shown" if painted else "own": shown}
        count, side, finest = len(shown), shown.shape[-1], min(finest, LEVELS - 1)
        if own is not None and masks is not None:
            count = len(masks)
            values |= {"own": own.expand(count, -1, -1, -1), "masks": masks}
        values |= {name: tables(device)[name] for name in ("reflected", "slopes", "of_bytes")}
        self._cloth = struct(Cloth, painted=painted, masked=masks is not None, **values)
        sides = [side >> level for level in range(finest, LEVELS)]
        sizes = [count * each**2 for each in sides]
        self._shape = {"textures": count, "finest": finest, "side": side}
        self.texels = torch.empty(sum(sizes), 3, device=device)
        parts = zip(self.texels.split(sizes), sides, strict=True)
        levels = [part.view(count, side, side, 3) for part, side in parts]
        rows(fill, levels[0].shape, self._cloth, 1 << finest, levels[0])
        for fine, coarse in pairwise(levels):
            pairs = fine[:, ::2] + fine[:, 1::2]
            torch.add(pairs[:, :, ::2], pairs[:, :, 1::2], out=coarse).mul_(0.25)
        self.pyramid = self._pyramid(self.texels)

    def back(self, to_texels: Float[Tensor, "K 3"], shape: torch.Size) -> Float[Tensor, "T 3 H H"]:
        """Returns the gradient of the shown textures from that of the texels."""
        to_shown = to_texels.new_zeros(shape)
        side = self._shape["side"] >> self._shape["finest"]
        dim = (len(to_shown), side, side)
        rows(fill_back, dim, self._cloth, self._pyramid(to_texels), to_shown)
        return to_shown

    def _pyramid(self, texels: Float[Tensor, "K 3"]) -> Any:
        return struct(Pyramid, texels=texels, **self._shape)


@cache
def tables(device: torch.device) -> dict[str, Tensor]:
    """Returns linear light, reflectance and its slope as piecewise linear functions of sRGB.

    `of_bytes` is the reflectance of each sRGB byte.
    """
    x = torch.arange(TABLE + 1, dtype=torch.float64) / TABLE
    with torch.enable_grad():
        linear = srgb_to_linear(x.requires_grad_())
        reflected = reflectance(linear)
        (slopes,) = torch.autograd.grad(reflected.sum(), x)
    curves = {"linear": linear.detach(), "reflected": reflected.detach(), "slopes": slopes}
    pieces = {
        name: torch.stack((curve[:-1], curve.diff()), dim=1).float().to(device)
        for name, curve in curves.items()
    }
    return pieces | {"of_bytes": reflectance(srgb_to_linear(torch.arange(256) / 255)).to(device)}
