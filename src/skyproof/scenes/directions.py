"""Maps of drivable ground: places for a vehicle's middle on a tile, and the heading there.

A pixel of 0 is no place for a vehicle. A pixel of v > 0 is one, with a heading of v - 1 degrees
from the tile's x axis (right) towards up, modulo 180: nose and tail are not distinguished.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from scipy import ndimage

_Grid = NDArray[np.floating[Any]]

HALF_WIDTH_M = 1.25
"""Radius of three free discs: around a vehicle's middle and around two points of its long axis."""
REACH_M = 1.4
"""Distance of these two points from the middle: the discs hold a whole car of 4.5 m x 1.7 m."""


def direction_values(heading_rad: _Grid) -> "UInt8[np.ndarray, ...]":
    """Returns the map's values for headings."""
    degrees = np.round(np.degrees(np.mod(heading_rad, math.pi))).astype(np.int64) % 180
    return (degrees + 1).astype(np.uint8)


def with_room(
    directions: UInt8[np.ndarray, "H W"], free: Bool[np.ndarray, "H W"], pixel_m: float
) -> UInt8[np.ndarray, "H W"]:
    """Keeps the places with room for a vehicle of 4.5 m x 1.7 m: three discs along its heading.

    `free` is ground without obstacles. Nothing beyond the map is free.
    """
    rows, columns = np.nonzero(directions)
    distance_m = pixel_m * ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    heading_rad = np.radians(directions[rows, columns].astype(np.float64) - 1)
    kept = np.ones(len(rows), dtype=bool)
    height, width = directions.shape
    for reach_m in (-REACH_M, 0.0, REACH_M):
        row = np.round(rows - reach_m / pixel_m * np.sin(heading_rad)).astype(int)
        column = np.round(columns + reach_m / pixel_m * np.cos(heading_rad)).astype(int)
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        room_m = distance_m[row.clip(0, height - 1), column.clip(0, width - 1)]
        kept &= inside & (room_m >= HALF_WIDTH_M)
    result = np.zeros_like(directions)
    result[rows[kept], columns[kept]] = directions[rows[kept], columns[kept]]
    return result
