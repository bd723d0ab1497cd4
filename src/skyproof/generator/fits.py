"""Fits of vehicles: stored row by row, good ones told from bad, put together for a generator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from skyproof.generator.maps import MAP_PX, unfolded
from skyproof.generator.prototypes import Prototype
from skyproof.vehicles.bodies import BodyDimensions
from skyproof.vehicles.vehicle import TEXTURE_SIZE

LARGEST_MISFIT = 0.05
"""Mean difference in sRGB from which on a fit is dropped: what stands there is no such vehicle, or
half of it is hidden. Drawn vehicles are fitted to 0.004 to 0.026."""

_ALONG = {
    "length",
    "wheelbase",
    "front_overhang",
    "bonnet_length",
    "windscreen_run",
    "rear_run",
    "deck_length",
}
_ACROSS = {"width", "tumblehome"}


@dataclass(frozen=True)
class Fit:
    """What a photographed vehicle was found to be.

    Attributes:
        id: of the photographed vehicle.
        prototype: number of the body it was fitted with.
        reversed: whether the nose points against the heading that was given.
        shift_m: along and across the vehicle, from the place that was given.
        turn_rad: from the heading that was given.
        stretch: factors of the body's length and width.
        paint, glass: sRGB.
        detail: what the left half of the map, mirrored, has on top of the coloured layers, sRGB.
        seen: how much each of its texels changes the picture, in parts of the most.
        misfit: mean difference of the two pictures in sRGB, where the vehicle is shown.
        runner_up: misfit of the best candidate with the nose at the other end, less that of the
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


class Fits:
    """Fits in the order of their vehicles; a part of the loop that makes them."""

    def __init__(self, ids: Sequence[str]) -> None:
        self._ids = tuple(ids)
        self._rows: list[dict[str, Tensor]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, fit: Fit) -> None:
        """Takes the next one."""
        self._rows.append(
            {
                "prototype": torch.tensor(fit.prototype),
                "reversed": torch.tensor(fit.reversed),
                "shift_m": torch.tensor(fit.shift_m),
                "turn_rad": torch.tensor(fit.turn_rad),
                "stretch": torch.tensor(fit.stretch),
                "paint": fit.paint,
                "glass": fit.glass,
                "detail": fit.detail,
                "seen": fit.seen,
                "misfit": torch.tensor(fit.misfit),
                "runner_up": torch.tensor(fit.runner_up),
            }
        )

    def fit(self, index: int) -> Fit:
        """Gives one of them."""
        row = self._rows[index]
        values: dict[str, Any] = {}
        for each in fields(Fit):
            if each.name == "id":
                values["id"] = self._ids[index]
            elif row[each.name].ndim == 0:
                values[each.name] = row[each.name].item()
            elif each.name in ("shift_m", "stretch"):
                values[each.name] = tuple(row[each.name].tolist())
            else:
                values[each.name] = row[each.name]
        return Fit(**values)

    def state_dict(self) -> dict[str, Any]:
        """Gives all rows, in one tensor for each value."""
        if not self._rows:
            return {}
        return {name: torch.stack([row[name] for row in self._rows]) for name in self._rows[0]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes over what `state_dict` gave."""
        count = len(next(iter(state_dict.values()))) if state_dict else 0
        self._rows = [
            {name: values[index].clone() for name, values in state_dict.items()}
            for index in range(count)
        ]


@dataclass(frozen=True)
class FittedVehicles:
    """What a generator learns from: one row per vehicle that was fitted well.

    Attributes:
        body_types: such as "saloon".
        dimensions: in metres, as stretched by the fit.
        paint, glass: sRGB.
        detail: on top of the coloured layers, left half, sRGB.
        seen: how much of each of its texels the photograph shows, 0 to 1.
        albedo: the whole map as it was fitted, left half, sRGB.
        parts: the share of each part in every texel, left half.
        vertices: of the fitted body, metres, vehicle axes.
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
    """Puts fits together with the bodies that they were fitted with."""
    half = MAP_PX // 2
    chosen = [prototypes[fit.prototype] for fit in fits]
    albedo, parts, vertices = [], [], []
    for fit, prototype in zip(fits, chosen, strict=True):
        layers = prototype.layers.at_side(MAP_PX)
        albedo.append(
            (layers.coloured(fit.paint, fit.glass)[..., :half] + fit.detail).clamp(0.0, 1.0)
        )
        labels = F.one_hot(prototype.parts.long(), 7).permute(2, 0, 1).float()
        parts.append(F.avg_pool2d(labels, labels.shape[-1] // MAP_PX)[..., :half])
        vertices.append(prototype.vertices * torch.tensor([*fit.stretch, 1.0]))
    return FittedVehicles(
        tuple(prototype.body_type for prototype in chosen),
        tuple(
            stretched(prototype.dimensions, *fit.stretch)
            for fit, prototype in zip(fits, chosen, strict=True)
        ),
        torch.stack([fit.paint for fit in fits]),
        torch.stack([fit.glass for fit in fits]),
        torch.stack([fit.detail for fit in fits]),
        torch.stack([fit.seen for fit in fits]),
        torch.stack(albedo),
        torch.stack(parts),
        torch.stack(vertices),
    )


def fitted_texture(fit: Fit, prototype: Prototype) -> Float[Tensor, "3 512 512"]:
    """Gives the texture that a vehicle was fitted with, sRGB in [0, 1].

    Args:
        fit: of the vehicle.
        prototype: the body that it was fitted with.
    """
    detail = unfolded(fit.detail[None], TEXTURE_SIZE)[0]
    return (prototype.layers.coloured(fit.paint, fit.glass) + detail).clamp(0.0, 1.0)


def stretched(dimensions: BodyDimensions, along: float, across: float) -> BodyDimensions:
    """Gives the dimensions of a body that is so many times as long and as wide."""
    changed = {name: getattr(dimensions, name) * along for name in _ALONG}
    changed |= {name: getattr(dimensions, name) * across for name in _ACROSS}
    return replace(dimensions, **changed)
