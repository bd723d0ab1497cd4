"""Bodies to begin a fit with: drawn ones, whose paint and glass can still be chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from skyproof.randomness import generator_of
from skyproof.vehicles.bodies import BodyDimensions, build_body, sample_dimensions
from skyproof.vehicles.painting import paint_vehicle

_BLACK, _WHITE = torch.zeros(3), torch.ones(3)


@dataclass(frozen=True)
class Layers:
    """A texture whose two main colours are left open: rest + paint share * paint + ...

    Attributes:
        rest: sRGB of tyres, trim, lamps and dust.
        paint_share: share of the body's paint in a texel.
        glass_share: share of the panes' colour.
    """

    rest: Float[Tensor, "*N 3 S S"]
    paint_share: Float[Tensor, "*N 1 S S"]
    glass_share: Float[Tensor, "*N 1 S S"]

    @classmethod
    def stacked(cls, layers: Sequence[Layers]) -> Layers:
        """Puts those of several textures together."""
        return cls(*(torch.stack(values) for values in zip(*map(_tensors, layers), strict=True)))

    def rows(self, index: Int[Tensor, " M"]) -> Layers:
        """Gives some of several textures."""
        return Layers(*(values[index] for values in _tensors(self)))

    def coloured(
        self, paint: Float[Tensor, "*N 3"], glass: Float[Tensor, "*N 3"]
    ) -> Float[Tensor, "*N 3 S S"]:
        """Gives the texture in these colours, sRGB."""
        return (
            self.rest
            + self.paint_share * paint[..., None, None]
            + self.glass_share * glass[..., None, None]
        )

    def at_side(self, side_px: int) -> Layers:
        """Gives the same layers on a coarser map: means of texels."""
        factor = self.rest.shape[-1] // side_px
        return Layers(*(F.avg_pool2d(values, factor) for values in _tensors(self)))


def _tensors(layers: Layers) -> tuple[Tensor, Tensor, Tensor]:
    return layers.rest, layers.paint_share, layers.glass_share


@dataclass(frozen=True)
class Prototype:
    """A body that was drawn by the rules of `skyproof vehicles`; metres and vehicle axes."""

    body_type: str
    dimensions: BodyDimensions
    vertices: Float[Tensor, "V 3"]
    layers: Layers
    parts: UInt8[Tensor, "512 512"]


def draw_prototypes(body_types: Sequence[str], each: int, seed: int) -> list[Prototype]:
    """Draws as many bodies of every type."""
    prototypes = []
    for body_type in body_types:
        for number in range(each):
            generator = generator_of(seed, body_type, number)
            dimensions = sample_dimensions(body_type, generator=generator)
            own_seed = int(torch.randint(2**31, (1,), generator=generator))
            prototypes.append(_prototype(body_type, dimensions, own_seed))
    return prototypes


def _prototype(body_type: str, dimensions: BodyDimensions, seed: int) -> Prototype:
    """Draws a body of given dimensions; the seed decides trim, pillars and roof."""
    body = build_body(dimensions)
    textures = []
    for paint, glass in ((_BLACK, _BLACK), (_WHITE, _BLACK), (_BLACK, _WHITE)):
        trim = generator_of(seed, "prototype")
        texture, parts = paint_vehicle(body, body_type, paint=paint, glass=glass, generator=trim)
        textures.append(texture.float() / 255)
    # A texel is a mean of its colours, so that differences are shares of them.
    rest, painted, glazed = textures
    layers = Layers(
        rest,
        (painted - rest).mean(0, keepdim=True).clamp(min=0.0),
        (glazed - rest).mean(0, keepdim=True).clamp(min=0.0),
    )
    return Prototype(body_type, dimensions, body.vertices, layers, parts)
