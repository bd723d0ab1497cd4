"""How imagery is read, cut, labelled and cleared.

Imports no torch, so that the command line answers at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from skyproof.errors import ConfigurationError

__all__ = ["ClearSettings", "LabelSettings", "SourceSettings", "TilingSettings"]


@dataclass(frozen=True)
class TilingSettings:
    """How ground is cut into tiles.

    Attributes:
        gsd_m: metres per pixel of the tiles.
        size_px: side of the tiles in pixels.
        minimum_px: side to which tiles may shrink until there is one for each of the four splits;
            imagery that still yields fewer is refused. Where it is not given, tiles do not shrink,
            and a split may stay empty.
        block_m: width in metres of the blocks of tiles that go to one split; about 400 where it is
            not given, less for little imagery.
        like: a tiled folder; the same ground is cut into the same tiles and splits from these
            sources.
    """

    gsd_m: float = 0.125
    size_px: int = 384
    minimum_px: int | None = None
    block_m: float | None = None
    like: Path | None = None

    def __post_init__(self) -> None:
        if (
            not 0 < self.gsd_m < math.inf
            or self.size_px < 1
            or not 0 < (self.block_m or 1) < math.inf
        ):
            raise ConfigurationError(
                "--tiling.gsd-m and --tiling.block-m expect metres above 0 and --tiling.size-px at "
                f"least 1 px, got {self.gsd_m}, {self.block_m} and {self.size_px}."
            )


@dataclass(frozen=True)
class SourceSettings:
    """What the user says about images that do not say it themselves.

    Attributes:
        gsd_m: metres per pixel of images without georeference.
        crs: reference system, such as EPSG:2193, of images that have a world file but name no
            system.
        licence: licence of images that state none (TIFFTAG_COPYRIGHT).
    """

    gsd_m: float | None = None
    crs: str | None = None
    licence: str | None = None

    def __post_init__(self) -> None:
        if self.gsd_m is not None and not 0 < self.gsd_m < math.inf:
            raise ConfigurationError(
                "The sources' metres per pixel (--source.gsd-m; --gsd of `demo`) must be above 0, "
                f"got {self.gsd_m}."
            )
        if self.crs is not None:
            # Loaded only where a system is named: it takes a second.
            from rasterio.crs import CRS
            from rasterio.errors import RasterioError

            try:
                CRS.from_user_input(self.crs)
            except (RasterioError, ValueError) as error:
                raise ConfigurationError(
                    f"--source.crs expects a system such as EPSG:2193, got {self.crs!r}."
                ) from error


@dataclass(frozen=True)
class LabelSettings:
    """Where labels of vehicles come from, and what in them counts as a vehicle.

    Attributes:
        path: COCO, YOLO text, DOTA text, GeoJSON, GeoPackage or Shapefile labels of vehicles.
        classes: class names that count as vehicles; all other objects become regions where nothing
            is scored. They may be left out where the labels know one class.
        border_px: width of a band along the border of each source, in its pixels, where nothing is
            scored: vehicles that the border cuts are often unlabelled.
        point_box_m: side of the box that stands for a point label; 4 m is a car's upright box at a
            random heading.
    """

    path: Path | None = None
    classes: tuple[str, ...] = ()
    border_px: float = 0.0
    point_box_m: float = 4.0

    def __post_init__(self) -> None:
        if not (0 <= self.border_px < math.inf and 0 < self.point_box_m < math.inf):
            raise ConfigurationError(
                "--labels.border-px expects a number of at least 0 and --labels.point-box-m one "
                f"above 0, got {self.border_px} and {self.point_box_m}."
            )


@dataclass(frozen=True)
class ClearSettings:
    """How vehicles are removed.

    Attributes:
        finding_score: every detection with at least this score is removed; it is low, because
            ground removed in vain costs less than a vehicle that stays.
        margin_m: width in metres by which vehicles' boxes are grown on all sides; doubled where the
            shadow is unknown.
        largest_masked_share: largest share of a tile that may be removed; a tile with more to
            remove is left out.
        rounds: how often a tile is repaired in which the check still finds something.
    """

    finding_score: float = 0.1
    margin_m: float = 0.4
    largest_masked_share: float = 0.35
    rounds: int = 2

    def __post_init__(self) -> None:
        shares = 0 < self.finding_score <= 1 and 0 < self.largest_masked_share < 1
        if not shares or self.margin_m < 0 or self.rounds < 0:
            raise ConfigurationError(
                "Clearing expects a score and a masked share between 0 and 1, and a margin and a "
                f"number of rounds of at least 0, but got {self}."
            )
