"""Fits of vehicles, and the drawn bodies that they begin with.

A body's paint and glass can still be chosen. Fits are stored row by row, good ones told from bad,
and put together for a generator.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.generator.maps import MAP_PX, unfolded
from skyproof.randomness import generator_of
from skyproof.vehicles.bodies import BodyDimensions, build_body, sample_dimensions
from skyproof.vehicles.painting import paint_vehicle
from skyproof.vehicles.vehicle import TEXTURE_SIZE

LARGEST_MISFIT = 0.05
"""Largest mean difference in sRGB of a fit that is kept. Fits of drawn vehicles reach 0.004 to
0.026; beyond the limit there is another object, or half of the vehicle is hidden."""

_ALONG = (
    *("length", "wheelbase", "front_overhang", "bonnet_length"),
    *("windscreen_run", "rear_run", "deck_length"),
)
_ACROSS = ("width", "tumblehome")
_BLACK, _WHITE = torch.zeros(3), torch.ones(3)


Layers = Float[Tensor, "*N 5 S S"]
"""Textures whose two main colours are left open: sRGB of tyres, trim, lamps and dust, and the
shares of the body's paint and of the panes' colour in a texel."""


def coloured(
    layers: Layers, paint: Float[Tensor, "*N 3"], glass: Float[Tensor, "*N 3"]
) -> Float[Tensor, "*N 3 S S"]:
    """Returns layers in these colours, sRGB."""
    rest, paint_share, glass_share = layers.split((3, 1, 1), dim=-3)
    return rest + paint_share * paint[..., None, None] + glass_share * glass[..., None, None]


def coarser(layers: Layers, side_px: int) -> Layers:
    """Returns the same layers on a coarser map: means of texels."""
    return F.avg_pool2d(layers, layers.shape[-1] // side_px)


@dataclass(frozen=True)
class Prototype:
    """A body that was drawn by the rules of `skyproof vehicles`; metres and vehicle axes."""

    body_type: str
    dimensions: BodyDimensions
    vertices: Float[Tensor, "V 3"]
    layers: Layers
    parts: UInt8[Tensor, "512 512"]


def draw_prototypes(body_types: Sequence[str], each: int, seed: int) -> list[Prototype]:
    """Draws `each` bodies of every type."""
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
    # A texel is a mean of its colours, so the differences are the shares of paint and glass.
    rest, painted, glazed = textures
    shares = [(each - rest).mean(0, keepdim=True).clamp(min=0.0) for each in (painted, glazed)]
    layers = torch.cat((rest, *shares))
    return Prototype(body_type, dimensions, body.vertices, layers, parts)


@dataclass(frozen=True)
class Fit:
    """The fit of a photographed vehicle.

    Attributes:
        prototype: number of the fitted body.
        reversed: whether the nose points against the given heading.
        shift_m: shift along and across the vehicle, from the given place.
        stretch: factors of the body's length and width.
        paint, glass: sRGB.
        detail: left half of the map on top of the coloured layers, sRGB.
        seen: how much each of its texels changes the picture, relative to the largest.
        misfit: mean difference of the two pictures in sRGB, where the vehicle is shown.
        runner_up: misfit of the best candidate with the nose at the other end, minus that of the
            chosen one, both before the texture was fitted.
    """

    id: str
    prototype: int
    reversed: bool
    shift_m: tuple[float, float]
    turn_rad: float
    stretch: tuple[float, float]
    paint: Float[Tensor, " 3"]
    glass: Float[Tensor, " 3"]
    detail: Float[Tensor, "3 64 32"]
    seen: Float[Tensor, "64 32"]
    misfit: float
    runner_up: float


_STORED = tuple(field.name for field in fields(Fit) if field.name != "id")


class Fits:
    """Fits in the order of their vehicles; a part of the loop that makes them."""

    def __init__(self, ids: Sequence[str]) -> None:
        self._ids = tuple(ids)
        self.done: list[Fit] = []

    def state_dict(self) -> dict[str, Any]:
        """Returns all fits, in one tensor for each value."""
        stored = _STORED if self.done else ()
        return {
            name: torch.stack([torch.as_tensor(getattr(fit, name)) for fit in self.done])
            for name in stored
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        rows = zip(*(state_dict[name] for name in _STORED if state_dict), strict=True)
        self.done = [
            Fit(name, *map(_value, _STORED, row))
            for name, row in zip(self._ids, rows, strict=False)
        ]


def _value(name: str, stored: Tensor) -> Any:
    if name in ("shift_m", "stretch"):
        return tuple(stored.tolist())
    return stored.clone() if stored.ndim else stored.item()


@dataclass(frozen=True)
class FittedVehicles:
    """What a generator learns from: one row per vehicle that was fitted well; colours are sRGB.

    Attributes:
        dimensions: as stretched by the fit.
        detail: left half of the map on top of the coloured layers.
        seen: how much of each of its texels the photograph shows, 0 to 1.
        albedo: left half of the whole fitted map.
        parts: share of each part in every texel, left half.
        vertices: surface of the fitted body, metres, vehicle axes.
    """

    body_types: tuple[str, ...]
    dimensions: tuple[BodyDimensions, ...]
    paint: Float[Tensor, "N 3"]
    glass: Float[Tensor, "N 3"]
    detail: Float[Tensor, "N 3 64 32"]
    seen: Float[Tensor, "N 64 32"]
    albedo: Float[Tensor, "N 3 64 32"]
    parts: Float[Tensor, "N 7 64 32"]
    vertices: Float[Tensor, "N V 3"]

    def __len__(self) -> int:
        return len(self.body_types)


def fitted_vehicles(fits: Sequence[Fit], prototypes: Sequence[Prototype]) -> FittedVehicles:
    """Combines fits with the bodies that they were made with."""
    half = MAP_PX // 2
    chosen = [prototypes[fit.prototype] for fit in fits]
    albedo: list[Tensor] = []
    parts: list[Tensor] = []
    vertices: list[Tensor] = []
    dimensions = []
    for fit, prototype in zip(fits, chosen, strict=True):
        texture = coloured(coarser(prototype.layers, MAP_PX), fit.paint, fit.glass)[..., :half]
        albedo.append((texture + fit.detail).clamp(0.0, 1.0))
        labels = F.one_hot(prototype.parts.long(), 7).permute(2, 0, 1).float()
        parts.append(F.avg_pool2d(labels, labels.shape[-1] // MAP_PX)[..., :half])
        vertices.append(prototype.vertices * torch.tensor([*fit.stretch, 1.0]))
        dimensions.append(_stretched(prototype.dimensions, *fit.stretch))
    own = [[getattr(fit, name) for fit in fits] for name in ("paint", "glass", "detail", "seen")]
    return FittedVehicles(
        tuple(prototype.body_type for prototype in chosen),
        tuple(dimensions),
        *map(torch.stack, (*own, albedo, parts, vertices)),
    )


def fitted_texture(fit: Fit, prototype: Prototype) -> Float[Tensor, "3 512 512"]:
    """Returns the texture of a fit on its body, sRGB in [0, 1]."""
    detail = unfolded(fit.detail[None], TEXTURE_SIZE)[0]
    return (coloured(prototype.layers, fit.paint, fit.glass) + detail).clamp(0.0, 1.0)


def _stretched(dimensions: BodyDimensions, along: float, across: float) -> BodyDimensions:
    """Returns the dimensions of a body stretched by factors along and across."""
    changed = {name: getattr(dimensions, name) * along for name in _ALONG}
    changed |= {name: getattr(dimensions, name) * across for name in _ACROSS}
    return replace(dimensions, **changed)
