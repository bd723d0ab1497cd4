"""Choices of places for vehicles, and the vehicles removed from a tile. Imports no torch."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from skyproof.ranges import Coordinate, Radians

DIRECTIONS = 180
"""The highest value in a map of drivable ground; see `skyproof.scenes.directions`."""

Places = Literal["uniform", "removed", "drivable"]

HeadingFrom = Literal["label", "picture"]
"""The heading comes from an oriented label, or from an estimate on the picture."""

_Side = Annotated[float, Meta(gt=0, le=1000)]


@dataclass(frozen=True)
class RemovedVehicle:
    """The place and heading of a vehicle that was removed from a tile; unknown values are None.

    The middle is in tile pixels from the top-left corner. The heading runs from the tile's x axis
    (right) towards up, modulo pi: nose and tail are not distinguished.
    """

    x_px: Coordinate
    y_px: Coordinate
    heading_rad: Radians | None = None
    heading_from: HeadingFrom | None = None
    length_m: _Side | None = None
    width_m: _Side | None = None
