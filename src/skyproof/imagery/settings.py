"""Settings for reading, cutting and labelling imagery. Imports no torch."""

import math
import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from tyro.conf import Suppress

from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, GroundResolution, check_ranges
from skyproof.scenes.splits import SPLITS, Split

_ROOM_PX = 112
"""Difference between the sides of procedural tiles and of the windows cut from them."""

_FIRST_YEAR, _LAST_YEAR = 1900, 2100
_SYSTEM = re.compile(r"[\w.]+(:[\w.]*)*|\+proj=[^/@]*|[A-Z_0-9]+\s*\[.*", re.DOTALL)
_TileSide = Annotated[int, Meta(ge=1, le=8192)]


def names_a_system(text: object) -> bool:
    """Returns whether a text is a code, PROJ text or WKT; GDAL would open an address or path."""
    return isinstance(text, str) and _SYSTEM.fullmatch(text) is not None


@dataclass(frozen=True)
class TilingSettings:
    """The size of the tiles, and their splits.

    Attributes:
        gsd_m: metres per pixel of the tiles.
        size_px: side of the tiles in pixels.
        minimum_px: side of the images that are cut from the tiles, to which tiles may shrink until
            there is one for each split, or else the imagery is refused; with None tiles keep their
            size and a split may stay empty.
        shares: shares of the tiles that go to train, validation, attack and test; a split with a
            share of 0 gets none.
    """

    gsd_m: GroundResolution = 0.125
    size_px: _TileSide = 384
    minimum_px: Suppress[_TileSide | None] = None
    shares: Suppress[tuple[Fraction, Fraction, Fraction, Fraction]] = (0.5, 0.15, 0.15, 0.2)

    def __post_init__(self) -> None:
        check_ranges(self)
        if abs(sum(self.shares) - 1) > 1e-6:
            raise ConfigurationError(
                "the shares of train, validation, attack and test expect a sum of 1, got "
                f"{' '.join(f'{share:g}' for share in self.shares)}."
            )

    @property
    def turning_px(self) -> int:
        """Side of the smallest tiles in which those images can turn freely."""
        if self.minimum_px is None:
            return self.size_px
        return min(self.size_px, _turning_px(self.minimum_px))

    @property
    def split_shares(self) -> dict[Split, float]:
        """The share of each split that gets tiles."""
        return {split: share for split, share in zip(SPLITS, self.shares, strict=True) if share}


@dataclass(frozen=True)
class SourceSettings:
    """Facts that images do not state themselves.

    Attributes:
        gsd_m: metres per pixel of images without georeference.
        crs: reference system of images with a world file alone or a local system, such as
            EPSG:2193.
        licence: licence of images that state none.
        taken: time of the flight with its zone, such as 2024-06-20T13:00:00+02:00. Vehicles are lit
            by the sun of that time.
    """

    gsd_m: GroundResolution | None = None
    crs: str | None = None
    licence: str | None = None
    taken: datetime | None = None

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.taken is not None and self.taken.tzinfo is None:
            raise ConfigurationError(
                f"--source.taken expects a time with its zone, got {self.taken.isoformat()}; add "
                "the zone, such as +02:00 or Z."
            )
        if self.taken is not None and not _FIRST_YEAR <= self.taken.year <= _LAST_YEAR:
            raise ConfigurationError(
                f"--source.taken expects a year from {_FIRST_YEAR} to {_LAST_YEAR}, got "
                f"{self.taken.year}."
            )
        if self.crs is not None:
            # Imported only for a named system, because the import takes a second.
            from rasterio.crs import CRS
            from rasterio.errors import RasterioError

            try:
                if not names_a_system(self.crs):
                    raise ValueError
                CRS.from_user_input(self.crs)
            except (RasterioError, ValueError) as error:
                raise ConfigurationError(
                    f"--source.crs expects a system such as EPSG:2193, got {self.crs!r}."
                ) from error


@dataclass(frozen=True)
class LabelSettings:
    """The labels of vehicles, and their vehicle classes.

    Attributes:
        path: labels as COCO, YOLO, DOTA or VisDrone text, Pascal VOC, GeoJSON, GeoPackage or
            Shapefile.
        classes: vehicle classes, if the labels have several classes. Other objects become ignore
            regions. FIELD=CLASS also names the field of a vector file.
    """

    path: Path | None = None
    classes: tuple[str, ...] = ()


def tiling_for_images(image_px: int, *, gsd_m: float, imagery: bool) -> TilingSettings:
    """Returns settings of tiles from which square images of `image_px` can be cut at any heading.

    Tiles of small `imagery` may shrink to one image, at fewer headings.
    """
    window_px = _turning_px(image_px)
    if imagery:
        return TilingSettings(gsd_m=gsd_m, size_px=window_px * 3 // 2, minimum_px=image_px)
    return TilingSettings(gsd_m=gsd_m, size_px=window_px + _ROOM_PX)


def _turning_px(image_px: int) -> int:
    return math.ceil(image_px * math.sqrt(2)) + 2
