"""The rectangles of ground below vehicles, and their overlaps."""

import math
from collections.abc import Mapping

from skyproof.scenes.scene import Placement

Rectangle = tuple[float, float, float, float, float]
"""Centre x, centre y, heading, length, width; metres and radians."""

Sizes = Mapping[str, tuple[float, float, float]]
"""Per vehicle id its length, width and height in metres."""


def footprint(placement: Placement, vehicle_sizes_m: Sizes, gap_m: float) -> Rectangle:
    """Gives the ground below a vehicle, with half of the gap to the next on every side."""
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
