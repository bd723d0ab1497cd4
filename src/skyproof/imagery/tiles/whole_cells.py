"""Chooses the photographs of a shared plane that show the cells of a grid."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from skyproof.imagery.tiles.sources import Source

Corners = NDArray[np.float64]
"""Of a photograph in the metres of its plane, clockwise, `[4, 2]`."""

Place = tuple[int, int]
"""Row and column of a cell."""

ALONG_RAD = math.radians(10.0)


def corners_of(source: Source) -> Corners:
    """Returns the corners of a photograph in its plane."""
    right, bottom = source.width_px, source.height_px
    corners = (0, 0), (right, 0), (right, bottom), (0, bottom)
    return np.array([source.georeference.transform * corner for corner in corners])


def shown_whole(
    corners: Mapping[int, Corners],
    near: Mapping[int, tuple[range, range]],
    north_west: tuple[float, float],
    side_m: float,
    slack_m: float,
) -> dict[Place, list[int]]:
    """Returns the cells that single photographs show whole, with their numbers, the best first.

    `near` are the columns and rows of the cells to try for each photograph. Those that lie along
    the grid come first, because upright boxes grow when they are turned, then those that add most
    cells, so that few photographs make many tiles.
    """
    shown: dict[int, set[Place]] = {}
    for number, (columns, rows) in near.items():
        row, column = (each.ravel() for each in np.meshgrid(rows, columns, indexing="ij"))
        inside = np.ones(len(row), bool)
        for right, down in ((0, 0), (1, 0), (1, 1), (0, 1)):
            x = north_west[0] + (column + right) * side_m
            y = north_west[1] - (row + down) * side_m
            inside &= _beyond_m(corners[number], x, y) <= slack_m
        shown[number] = {*zip(row[inside].tolist(), column[inside].tolist(), strict=True)}
    order: list[int] = []
    known: set[Place] = set()
    along = {number: _lies_along(its) for number, its in corners.items()}
    waiting = [*shown]
    while waiting:
        best = max(waiting, key=lambda number: (along[number], len(shown[number] - known)))
        waiting.remove(best)
        order.append(best)
        known |= shown[best]
    return {
        place: [number for number in order if place in shown[number]] for place in sorted(known)
    }


def _beyond_m(corners: Corners, x: NDArray[np.float64], y: NDArray[np.float64]) -> Corners:
    """Returns how far places lie beyond the sides of a photograph, less than 0 inside."""
    beyond_m = np.full(x.shape, -np.inf)
    for (from_x, from_y), (to_x, to_y) in zip(corners, np.roll(corners, -1, 0), strict=True):
        across, up = to_x - from_x, to_y - from_y
        left = across * (y - from_y) - up * (x - from_x)
        beyond_m = np.maximum(beyond_m, left / math.hypot(across, up))
    return beyond_m


def _lies_along(corners: Corners) -> bool:
    """Returns whether the sides of a photograph run along the axes of its plane."""
    across, up = corners[1] - corners[0]
    turn_rad = math.atan2(up, across) % (math.pi / 2)
    return min(turn_rad, math.pi / 2 - turn_rad) < ALONG_RAD
