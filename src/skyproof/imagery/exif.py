"""Reads the time, place and resolution that a photograph states."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

from rasterio.io import DatasetReader

from skyproof.words import span

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""Focal lengths "in 35 mm film" are those of this diagonal (EXIF 2.32)."""
_NADIR_DEG = -80.0
_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Exif:
    """Facts of a photograph, each None if it is not stated.

    Attributes:
        taken: date and time of the camera's clock, whose zone is not known.
        place: longitude and latitude of the camera in degrees.
        gsd_m: metres per pixel by focal length and height above the take-off point, on flat ground.
    """

    taken: datetime | None = None
    place: tuple[float, float] | None = None
    gsd_m: float | None = None


def read_exif(dataset: DatasetReader) -> Exif:
    """Reads EXIF data as GDAL returns them; damaged values count as not stated."""
    tags = dataset.tags()
    xmp = "".join(dataset.tags(ns="xml:XMP").values())
    taken = None
    with suppress(KeyError, ValueError):
        taken = datetime.strptime(tags["EXIF_DateTimeOriginal"], "%Y:%m:%d %H:%M:%S")
    return Exif(taken, _place(tags), _gsd_m(tags, xmp, dataset.width, dataset.height))


def exif_words(photographs: Sequence[Exif]) -> Iterator[str]:
    """Yields at most one sentence, on the times and places of photographs."""
    times = sorted(one.taken for one in photographs if one.taken)
    places = [one.place for one in photographs if one.place]
    told = []
    if times:
        first, last = f"{times[0]:%Y-%m-%d %H:%M}", f"{times[-1]:%Y-%m-%d %H:%M}"
        told.append(f"taken at {first}" if first == last else f"taken from {first} to {last}")
    if places:
        longitudes, latitudes = zip(*places, strict=True)
        told.append(
            f"at latitude {span(min(latitudes), max(latitudes), 2)} and longitude "
            f"{span(min(longitudes), max(longitudes), 2)}"
        )
    if told:
        stated = sum(one.taken is not None or one.place is not None for one in photographs)
        yield f"By their EXIF data, {stated} of {len(photographs)} images were {', '.join(told)}"


def _place(tags: Mapping[str, str]) -> tuple[float, float] | None:
    degrees = []
    for axis, negative, most in (("Longitude", "W", 180.0), ("Latitude", "S", 90.0)):
        parts = [float(one) for one in _NUMBER.findall(tags.get(f"EXIF_GPS{axis}", ""))]
        value = sum(part / 60**power for power, part in enumerate(parts))
        if len(parts) != 3 or not 0 <= value <= most:
            return None
        degrees.append(-value if tags.get(f"EXIF_GPS{axis}Ref") == negative else value)
    # Receivers without a fix write zeros.
    return (degrees[0], degrees[1]) if any(degrees) else None


def _gsd_m(tags: Mapping[str, str], xmp: str, width_px: int, height_px: int) -> float | None:
    height_m = _stated(xmp, "RelativeAltitude")
    pitch_deg = _stated(xmp, "GimbalPitchDegree")
    focal_mm = float((_NUMBER.findall(tags.get("EXIF_FocalLengthIn35mmFilm", "")) or ["0"])[0])
    # The formula holds only for a whole picture that was taken straight down.
    whole = tags.get("EXIF_PixelXDimension") in (str(width_px), str(height_px))
    oblique = pitch_deg is not None and pitch_deg > _NADIR_DEG
    if height_m is None or height_m <= 0 or focal_mm <= 0 or oblique or not whole:
        return None
    return height_m * _FILM_DIAGONAL_MM / focal_mm / math.hypot(width_px, height_px)


def _stated(xmp: str, name: str) -> float | None:
    """Returns a number that DJI's drones write into XMP."""
    found = re.search(rf"drone-dji:{name}(?:\s*=\s*[\"']|>)\s*([+-]?\d+(?:\.\d+)?)", xmp)
    return None if found is None else float(found[1])
