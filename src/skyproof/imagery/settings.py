"""How imagery is read, cut, labelled and cleared.

Imports no torch, so that the command line answers at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, GroundResolution, check_ranges
from skyproof.scenes.splits import SPLITS, Split

_ROOM_PX = 112
"""By which procedural tiles are larger than the windows cut from them."""

_TileSide = Annotated[int, Meta(ge=1, le=8192)]
_Score = Annotated[float, Meta(gt=0, le=1)]


@dataclass(frozen=True)
class TilingSettings:
    """How ground is cut into tiles.

    Attributes:
        gsd_m: metres per pixel of the tiles.
        size_px: side of the tiles in pixels.
        minimum_px: side to which tiles may shrink until there is one for each split; imagery that
            still yields fewer is refused. Where it is not given, tiles do not shrink, and a split
            may stay empty.
        block_m: width in metres of the blocks of tiles that go to one split; about 400 where it is
            not given, less for little imagery.
        like: a tiled folder; the same ground is cut into the same tiles and splits from these
            sources, in its resolution and sizes.
        shares: of the tiles that go to train, validation, attack and test; a split whose share is
            0 gets none.
    """

    gsd_m: GroundResolution = 0.125
    size_px: _TileSide = 384
    minimum_px: _TileSide | None = None
    block_m: Annotated[float, Meta(ge=0.1, le=1e6)] | None = None
    like: Path | None = None
    shares: tuple[Fraction, Fraction, Fraction, Fraction] = (0.5, 0.15, 0.15, 0.2)

    def __post_init__(self) -> None:
        check_ranges(self)
        if abs(sum(self.shares) - 1) > 1e-6:
            raise ConfigurationError(
                "the shares of train, validation, attack and test expect a sum of 1, got "
                f"{' '.join(f'{share:g}' for share in self.shares)}."
            )

    @property
    def split_shares(self) -> dict[Split, float]:
        """The share of each split that gets tiles."""
        named = zip(SPLITS, self.shares, strict=True)
        return {split: share for split, share in named if share}


@dataclass(frozen=True)
class SourceSettings:
    """What the user says about images that do not say it themselves.

    Attributes:
        gsd_m: metres per pixel of images without georeference.
        crs: reference system, such as EPSG:2193, of images that have a world file but name no
            system.
        licence: licence of images that state none (TIFFTAG_COPYRIGHT).
        taken: when the images were taken, with its time zone, such as 2024-06-20T13:00:00+02:00:
            vehicles then stand in the sun of that moment. Images of several flights are cut one
            by one.
        cover: a mask, or a folder with a mask for each image, of its name and size: white where
            tree crowns, roofs or bridges hide the ground, so that they hide vehicles there, too.
    """

    gsd_m: GroundResolution | None = None
    crs: str | None = None
    licence: str | None = None
    taken: datetime | None = None
    cover: Path | None = None

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.taken is not None and self.taken.tzinfo is None:
            raise ConfigurationError(
                f"--source.taken expects a time with its zone, got {self.taken.isoformat()}; add "
                "the zone, such as +02:00 or Z."
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
    border_px: Annotated[float, Meta(ge=0, le=100_000)] = 0.0
    point_box_m: Annotated[float, Meta(ge=0.01, le=100)] = 4.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class ClearSettings:
    """How vehicles are removed.

    Attributes:
        finding_score: every detection with at least this score is removed; where not given, the
            detector's frozen threshold. A lower one leaves fewer vehicles, and removes ground.
        margin_m: width in metres by which vehicles' boxes are grown on all sides; doubled where the
            shadow is unknown.
        largest_masked_share: largest share of a tile that may be removed; a tile with more to
            remove is left out.
        rounds: how often a tile is repaired in which the check still finds something.
    """

    finding_score: _Score | None = None
    margin_m: Annotated[float, Meta(ge=0, le=100)] = 0.4
    largest_masked_share: Annotated[float, Meta(gt=0, lt=1)] = 0.35
    rounds: Annotated[int, Meta(ge=0, le=100)] = 2

    def __post_init__(self) -> None:
        check_ranges(self)


def tiling_for_images(image_px: int, *, gsd_m: float, imagery: bool) -> TilingSettings:
    """Returns tiles from which square images of `image_px` can be cut at any heading.

    Args:
        image_px: side of the images in pixels.
        gsd_m: metres per pixel of tiles and images.
        imagery: whether the ground is imagery, whose tiles may shrink to what one image needs.
    """
    window_px = math.ceil(image_px * math.sqrt(2)) + 2
    if imagery:
        return TilingSettings(gsd_m=gsd_m, size_px=window_px * 3 // 2, minimum_px=window_px)
    return TilingSettings(gsd_m=gsd_m, size_px=window_px + _ROOM_PX)
