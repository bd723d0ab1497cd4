"""Chooses the photographs of a shared plane that show the cells of a grid."""

import math
from collections.abc import Mapping

import numpy as np
import shapely
from shapely import Polygon

from skyproof.imagery.tiles.georeference import outline
from skyproof.imagery.tiles.sources import Source

Place = tuple[int, int]
"""Row and column of a cell."""

ALONG_RAD = math.radians(10.0)


def outline_of(source: Source) -> Polygon:
    """Returns the outline of a photograph in the metres of its plane, clockwise."""
    corners = outline(source.width_px, source.height_px, steps=1)
    return Polygon([source.georeference.transform * corner for corner in corners])


def shown_whole(
    outlines: Mapping[int, Polygon],
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
        left, top = north_west[0] + column * side_m, north_west[1] - row * side_m
        wider = outlines[number].buffer(slack_m, join_style="mitre")
        inside = shapely.covers(wider, shapely.box(left, top - side_m, left + side_m, top))
        shown[number] = {*zip(row[inside].tolist(), column[inside].tolist(), strict=True)}
    order: list[int] = []
    known: set[Place] = set()
    along = {number: _lies_along(its) for number, its in outlines.items()}
    waiting = [*shown]
    while waiting:
        best = max(waiting, key=lambda number: (along[number], len(shown[number] - known)))
        waiting.remove(best)
        order.append(best)
        known |= shown[best]
    return {
        place: [number for number in order if place in shown[number]] for place in sorted(known)
    }


def _lies_along(photograph: Polygon) -> bool:
    """Returns whether the sides of a photograph run along the axes of its plane."""
    (left, from_y), (right, to_y), *_ = photograph.exterior.coords
    turn_rad = math.atan2(to_y - from_y, right - left) % (math.pi / 2)
    return min(turn_rad, math.pi / 2 - turn_rad) < ALONG_RAD
