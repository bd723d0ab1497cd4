"""How vehicles stand: apart from each other, in shadows, beneath crowns and roofs."""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from shapely import Polygon

from skyproof.scenes.backgrounds import BackgroundSet, read_map
from skyproof.scenes.scene import BackgroundWindow, Placement

_ALONG, _ACROSS = 9, 5
"""Numbers of points along and across a vehicle's footprint at which the maps are read."""

_ON_TOP_FROM = 0.5

Sizes = Mapping[str, tuple[float, float, float]]
"""Per vehicle id its length, width and height in metres."""


def footprint(placement: Placement, vehicle_sizes_m: Sizes, gap_m: float) -> Polygon:
    """Returns the ground below a vehicle, with half of the gap to its neighbours on every side."""
    length_m, width_m, _ = vehicle_sizes_m[placement.vehicle]
    middle, nose = complex(placement.x_m, placement.y_m), cmath.rect(0.5, placement.heading_rad)
    ahead, left = (length_m + gap_m) * nose, (width_m + gap_m) * 1j * nose
    corners = (ahead + left, ahead - left, -ahead - left, left - ahead)
    return Polygon([((middle + each).real, (middle + each).imag) for each in corners])


def standing(
    placements: Sequence[Placement],
    backgrounds: BackgroundSet,
    window: BackgroundWindow,
    vehicle_sizes_m: Sizes,
    *,
    shadows: bool,
    on_top_from: float = _ON_TOP_FROM,
) -> tuple[Placement, ...]:
    """Returns vehicles with the mean shadow over their footprints, if `shadows`, and their cover.

    If crowns and roofs cover less than `on_top_from` of its footprint, a vehicle stands beneath
    them, and otherwise on top of them, because uniform places put vehicles on anything.
    """
    shade = backgrounds.map_of(window.tile, "shade") if shadows else None
    cover = backgrounds.map_of(window.tile, "cover")
    if not len(placements) or (shade is None and cover is None):
        return tuple(placements)
    along = (torch.arange(_ALONG, dtype=torch.float64) + 0.5) / _ALONG - 0.5
    across = (torch.arange(_ACROSS, dtype=torch.float64) + 0.5) / _ACROSS - 0.5
    along, across = (each.flatten() for each in torch.meshgrid(along, across, indexing="ij"))
    found = []
    for placement in placements:
        length_m, width_m, _ = vehicle_sizes_m[placement.vehicle]
        cosine, sine = math.cos(placement.heading_rad), math.sin(placement.heading_rad)
        east_m = placement.x_m + cosine * length_m * along - sine * width_m * across
        north_m = placement.y_m + sine * length_m * along + cosine * width_m * across
        east_px, north_px = east_m / backgrounds.gsd_m, north_m / backgrounds.gsd_m
        shares = []
        for values in (shade, cover):
            mean = 0.0
            if values is not None:
                mean = float(read_map(values, window, east_px, north_px).double().mean()) / 255
            shares.append(round(mean, 3))
        shaded, covered = shares
        beneath = covered if covered < on_top_from else 0.0
        found.append(replace(placement, shade=shaded, covered=beneath))
    return tuple(found)
