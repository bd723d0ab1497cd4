"""Where scenes put vehicles, and what a tile knows of it. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import Coordinate, Radians

DIRECTIONS = 180
"""The highest value in a map of drivable ground; see `skyproof.scenes.directions`."""

Places = Literal["uniform", "removed", "drivable"]
"""Anywhere; where vehicles stood before the ground was cleared; where vehicles may stand."""

HeadingFrom = Literal["label", "picture"]
"""An oriented label said the heading, or it was estimated from the picture."""

_Side = Annotated[float, Meta(gt=0, le=1000)]


@dataclass(frozen=True)
class RemovedVehicle:
    """Where and how a vehicle stood that was removed from a tile.

    Attributes:
        x_px: its middle in tile pixels from the left edge, continuous.
        y_px: the same from the top edge.
        heading_rad: from the tile's x axis (right) towards up, modulo pi: nose and tail are not
            told apart. None where it is not known.
        heading_from: how the heading is known; None where it is not.
        length_m: in metres; None where not known.
        width_m: the same.
    """

    x_px: Coordinate
    y_px: Coordinate
    heading_rad: Radians | None = None
    heading_from: HeadingFrom | None = None
    length_m: _Side | None = None
    width_m: _Side | None = None
