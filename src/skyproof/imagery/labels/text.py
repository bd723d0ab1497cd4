"""Holds what text label formats share: numbered lines, and the image that a text belongs to."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path

from rasterio.errors import NotGeoreferencedWarning, RasterioError

from skyproof.errors import ImageryError
from skyproof.imagery.rasters import RASTER_SUFFIXES, open_raster

LARGEST_NUMBER = 1e9
"""Pixels, metres or degrees: no label lies farther away."""

_LARGEST_BYTES = 256 * 2**20

IMAGE_FOLDER = "images"
LABEL_FOLDERS = ("labels", "labelTxt")
"""Names that stand where `images` stands in the path of an image, by Ultralytics and DOTA."""


def read_text(path: Path) -> str:
    """Reads a label file of any length a person could want.

    Raises:
        ImageryError: the file is missing, not text, or longer than 256 MiB.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise ImageryError(f"{path} is longer than 256 MiB; split the labels.")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ImageryError(f"{path} is missing; give label text (.txt) in UTF-8.") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ImageryError(
            f"{path} is not text that can be read ({reason}); give label text in UTF-8."
        ) from error


def text_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Returns the words of every line that is not blank, with its number from 1.

    Raises:
        ImageryError: the file is missing, or not text.
    """
    lines = read_text(path).splitlines()
    return [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip()]


def finite_numbers(words: Sequence[str]) -> list[float]:
    """Returns the words as numbers.

    Raises:
        ValueError: one is no number, or farther from 0 than `LARGEST_NUMBER`.
    """
    values = [float(word) for word in words]
    if not all(math.isfinite(value) and abs(value) <= LARGEST_NUMBER for value in values):
        raise ValueError("not a number of a label")
    return values


def image_of(text: Path) -> Path | None:
    """Finds the image of the same stem, beside the text or in `images` instead of `labels`."""
    folders = [text.parent]
    parts = list(text.parent.parts)
    for index in reversed(range(len(parts))):
        if parts[index] in LABEL_FOLDERS:
            folders.append(Path(*parts[:index], IMAGE_FOLDER, *parts[index + 1 :]))
            break
    for folder in folders:
        for suffix in RASTER_SUFFIXES:
            for spelt in (suffix, suffix.upper()):
                image = folder / f"{text.stem}{spelt}"
                if image.is_file():
                    return image
    return None


def image_size_px(path: Path) -> tuple[int, int]:
    """Reads width and height from an image's header.

    Raises:
        ImageryError: it cannot be read.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with open_raster(path) as dataset:
                return int(dataset.width), int(dataset.height)
    except (RasterioError, OSError, ValueError) as error:
        raise ImageryError(
            f"{path} cannot be read as an image; replace it, or leave it out."
        ) from error


def name_once(name: str, known: Collection[str], where: Path) -> None:
    """Labels go by the name of their image: two images of one name would be mixed up.

    Raises:
        ImageryError: the name is known already.
    """
    if name in known:
        raise ImageryError(
            f"{where} labels two images called {name!r}; rename one of them, or split the labels."
        )
