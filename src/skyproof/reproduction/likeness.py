"""How alike two textures are, texel by texel and as coarsely as the renderer reads them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.geometry.colour import linear_to_srgb, srgb_to_cielab, srgb_to_linear

SEEN_TEXELS = 4
"""Side in texels of the blocks that the renderer reads most: five samples in eight see the mean of
4 x 4 texels (docs/conventions.md)."""


@dataclass(frozen=True)
class Worn:
    """A texture's colours and how much each counts.

    Attributes:
        colours: `[3, H, W]` sRGB in [0, 1].
        area: `[H, W]` of each on the vehicles that wear it.
    """

    colours: Float[Tensor, "3 H W"]
    area: Float[Tensor, "H W"]

    @classmethod
    def of(cls, texture: UInt8[Tensor, "3 H W"], area: Float[Tensor, "H W"]) -> Worn:
        """Takes a texture of 8 bits."""
        return cls(texture.float() / 255, area)

    def seen(self) -> Worn:
        """Averages over blocks of `SEEN_TEXELS`, in linear light, as the renderer does."""
        total = _summed(self.area)
        light = _summed(srgb_to_linear(self.colours) * self.area)
        return Worn(linear_to_srgb(light / total.clamp(min=1e-12)), total)


@dataclass(frozen=True)
class Likeness:
    """How alike two textures are on the vehicles that wear them.

    Attributes:
        correlation: of the two textures' values, per channel about its mean, mean over the
            channels; None where one channel of either is the same everywhere. 0 is expected of
            textures that have nothing to do with each other.
        distance: mean distance of the two colours in CIELAB (CIE 1976). 2.3 can just be noticed
            (Mahy and others 1994).
    """

    correlation: float | None
    distance: float


def likeness(first: Worn, second: Worn) -> Likeness:
    """Compares two textures of one size, each texel by the area that both cover."""
    area = torch.minimum(first.area, second.area).double().flatten()
    shares = area / area.sum()

    # Correlation of each channel.
    one, other = (worn.colours.double().flatten(1) for worn in (first, second))
    one = one - (one @ shares)[:, None]
    other = other - (other @ shares)[:, None]
    spread = ((one**2 @ shares) * (other**2 @ shares)).sqrt()
    known = bool((spread > 1e-9).all())
    products = ((one * other) @ shares / spread).clamp(-1.0, 1.0)
    correlation = float(products.mean()) if known else None

    # Distance of the colours.
    cielab = [srgb_to_cielab(worn.colours.flatten(1).T) for worn in (first, second)]
    distance = float((cielab[0] - cielab[1]).norm(dim=-1).double() @ shares)
    return Likeness(correlation, distance)


def _summed(values: Float[Tensor, "*C H W"]) -> Float[Tensor, "*C h w"]:
    return values.unflatten(-1, (-1, SEEN_TEXELS)).unflatten(-3, (-1, SEEN_TEXELS)).sum((-3, -1))
