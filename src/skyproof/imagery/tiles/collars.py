"""Finds the empty collar around a warped or cut orthophoto that declares no nodata value."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Compression
from rasterio.io import DatasetReader
from rasterio.windows import Window
from scipy.ndimage import label

from skyproof.imagery.rasters import is_faster_whole

_CORNER_PX = 4
_LEAST_SHARE = 0.002
"""Of an image: less is a shadow or a roof at its corner."""
_STRIP_PX = 2**22
_VIEW_PX = 1024

# Lossy compression spoils flat colours by a few values, and the pixels of a block that an edge
# crosses by more. Blocks of colour are up to 16 px wide in JPEG.
_LOSSY_VALUES = 3
_LOSSY_PX = 16
_LOSSY_DRIVERS = ("JPEG", "JP2OpenJPEG", "VRT")
"""A VRT does not say how its images are compressed."""
_LOSSY_COMPRESSIONS = (Compression.jpeg, Compression.jpeg2000, Compression.webp, Compression.lerc)


@dataclass(frozen=True, eq=False)
class Collar:
    """What lies between an image's border and the first pixel of another colour, along its axes.

    Attributes:
        columns: first and last column, `[2, H]`, that belong to the picture in each row; the first
            lies behind the last where there is none.
        rows: first and last row, `[2, W]`, in each column.
    """

    colour: str
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]

    def covers(self, window: Window, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Returns which pixels of a window that is read in this shape belong to the collar."""
        row = (window.row_off + _middles(window.height, shape[0]))[:, None]
        column = (window.col_off + _middles(window.width, shape[1]))[None]
        first_column, last_column = self.columns[:, row]
        first_row, last_row = self.rows[:, column]
        beside = (column < first_column) | (column > last_column)
        return beside | (row < first_row) | (row > last_row)


def _middles(length: float, count: int) -> NDArray[np.int64]:
    return ((np.arange(count) + 0.5) * (length / count)).astype(np.int64)


def is_lossy(dataset: DatasetReader) -> bool:
    """Returns whether compression may have changed the picture's values."""
    return dataset.driver in _LOSSY_DRIVERS or dataset.compression in _LOSSY_COMPRESSIONS


def corners_of(dataset: DatasetReader) -> Iterator[Window]:
    """Yields small windows at the corners of an image."""
    width, height = (min(_CORNER_PX, side) for side in (dataset.width, dataset.height))
    # Photographs have a collar on all sides or none, and reading lower corners decodes all of them.
    photograph = dataset.driver == "JPEG" and dataset.transform.is_identity
    for top in (0,) if photograph else (0, dataset.height - height):
        for left in (0, dataset.width - width):
            yield Window(left, top, width, height)


def find_collars(
    dataset: DatasetReader, bands: Sequence[int], corners: Sequence[Window]
) -> tuple[Collar, ...]:
    """Finds collars of the darkest and of the brightest possible value in all bands.

    An image has one if one of `corners` shows nothing else, and if its parts at the corners make up
    0.2 % of the image or more. Only an image with such a corner is read, strip by strip. Shadows
    and white roofs inside the image are not reached from its border.
    """
    if not corners:
        return ()
    kind = np.dtype(dataset.dtypes[bands[0] - 1])
    extremes = {"black": 0.0}
    if kind.kind in "ui":
        extremes["white"] = float(np.iinfo(kind).max)
    tolerance = _LOSSY_VALUES if is_lossy(dataset) else 0
    found = []
    if is_faster_whole(dataset):
        whole = dataset.read(list(bands))
        shown = [whole[:, *at.toslices()] for at in corners]
    else:
        # Read once and from top to bottom: a PNG is decoded up to the row that is asked for.
        shown = [dataset.read(list(bands), window=at) for at in corners]
    for colour, value in extremes.items():
        if any(not _differs(values, value, tolerance).any() for values in shown):
            collar = _between(dataset, bands, colour, value, tolerance)
            if _share_at_corners(collar, dataset) >= _LEAST_SHARE:
                found.append(collar)
    return tuple(found)


def _share_at_corners(collar: Collar, dataset: DatasetReader) -> float:
    """Returns which share of an image the parts of a collar have that reach into its corners."""
    shape = min(dataset.height, _VIEW_PX), min(dataset.width, _VIEW_PX)
    parts, _ = label(collar.covers(Window(0, 0, dataset.width, dataset.height), shape))
    corners = parts[np.ix_((0, -1), (0, -1))]
    return float(np.isin(parts, corners[corners > 0]).mean())


def _differs(values: NDArray[np.generic], value: float, tolerance: int) -> NDArray[np.bool_]:
    return (np.abs(values.astype(np.float32) - np.float32(value)) > tolerance).any(0)


def _between(
    dataset: DatasetReader, bands: Sequence[int], colour: str, value: float, tolerance: int
) -> Collar:
    width, height = dataset.width, dataset.height
    columns = np.tile([[width], [-1]], (1, height))
    rows = np.tile([[height], [-1]], (1, width))
    step = max(1, _STRIP_PX // width)
    for top in range(0, height, step):
        count = min(step, height - top)
        values = dataset.read(list(bands), window=Window(0, top, width, count))
        picture = _differs(values, value, tolerance)
        some = picture.any(1)
        strip = columns[:, top : top + count]
        strip[0, some] = picture.argmax(1)[some]
        strip[1, some] = width - 1 - picture[:, ::-1].argmax(1)[some]
        some = picture.any(0)
        rows[0, some] = np.minimum(rows[0], top + picture.argmax(0))[some]
        rows[1, some] = top + count - 1 - picture[::-1].argmax(0)[some]
    if tolerance:
        # Pixels at the edge of a collar are spoilt; lines without a collar stay whole.
        for lines, last in ((columns, width - 1), (rows, height - 1)):
            lines[0][lines[0] > 0] += _LOSSY_PX
            lines[1][lines[1] < last] -= _LOSSY_PX
    return Collar(colour, columns, rows)
