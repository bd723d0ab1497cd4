"""How vehicles stand: apart from each other, in shadows, beneath crowns and roofs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from skyproof.scenes.backgrounds import BackgroundSet, read_map
from skyproof.scenes.scene import BackgroundWindow, Placement

_ALONG, _ACROSS = 9, 5
"""Numbers of points along and across a vehicle's footprint at which the maps are read."""

_ON_TOP_FROM = 0.5

Rectangle = tuple[float, float, float, float, float]
"""Centre x, centre y, heading, length, width; metres and radians."""

Sizes = Mapping[str, tuple[float, float, float]]
"""Per vehicle id its length, width and height in metres."""


def footprint(placement: Placement, vehicle_sizes_m: Sizes, gap_m: float) -> Rectangle:
    """Returns the ground below a vehicle, with half of the gap to its neighbours on every side."""
    length_m, width_m, _ = vehicle_sizes_m[placement.vehicle]
    return placement.x_m, placement.y_m, placement.heading_rad, length_m + gap_m, width_m + gap_m


def rectangles_overlap(first: Rectangle, second: Rectangle) -> bool:
    """Whether two turned rectangles share area, by the separating axis test."""
    dx = second[0] - first[0]
    dy = second[1] - first[1]
    for heading in (first[2], second[2]):
        for axis_rad in (heading, heading + math.pi / 2):
            distance = abs(dx * math.cos(axis_rad) + dy * math.sin(axis_rad))
            if distance >= _half_extent(first, axis_rad) + _half_extent(second, axis_rad):
                return False
    return True


def _half_extent(rectangle: Rectangle, axis_rad: float) -> float:
    _, _, heading, length, width = rectangle
    along = length * abs(math.cos(axis_rad - heading))
    across = width * abs(math.sin(axis_rad - heading))
    return (along + across) / 2


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
        x_m, y_m, heading_rad, length_m, width_m = footprint(placement, vehicle_sizes_m, 0.0)
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        east_px = (x_m + cosine * length_m * along - sine * width_m * across) / backgrounds.gsd_m
        north_px = (y_m + sine * length_m * along + cosine * width_m * across) / backgrounds.gsd_m
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
