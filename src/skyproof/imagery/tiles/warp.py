"""Resamples one cell of ground out of one or several sources, in true metres, anti-aliased."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.io import DatasetReader
from rasterio.warp import reproject
from rasterio.windows import Window
from scipy.ndimage import distance_transform_edt

from skyproof.imagery.tiles.georeference import outline, to_reference_system
from skyproof.imagery.tiles.grid import FULL_SHARE, Cell
from skyproof.imagery.tiles.sources import Source, SourceReader, read_mask

SHRINKING_FROM = 1.1
PIECE_PX = 2048

_Value = TypeVar("_Value", bound=np.generic)

# Two sides in the same system: which one does not matter.
_NO_SYSTEM = CRS.from_epsg(32631)


@dataclass(frozen=True)
class CellImage:
    """What sources show of a cell.

    Attributes:
        pixels: `[3, S, S]` sRGB bytes.
        owner: `[S, S]` the number of the source of each pixel, -1 where none has data.
    """

    pixels: NDArray[np.uint8]
    owner: NDArray[np.int32]


def read_cell(cell: Cell, sources: Sequence[Source], reader: SourceReader) -> CellImage | None:
    """Reads what is needed of the sources, and nothing else.

    The first source that fills the cell to 98 % gives all of it. Where none does, as on the seam of
    two sheets, each source fills what those before it left empty. Where even all together do not,
    there is no tile. The 2 % that may be empty take the colour of the nearest pixel that is not: a
    black edge would be learnt as a sign. So do empty pixels of a source before it is resampled: the
    values there mean nothing.

    Shrinking averages over the area of a pixel, because point sampling would alias fine structure
    into coarse patterns; otherwise pixels are interpolated by cubic convolution, which copies them
    exactly where the grids coincide. Overviews inside the files are not used: many were made by
    point sampling.

    Raises:
        ImageryError: a source cannot be read.
    """
    parts: list[tuple[int, NDArray[np.uint8], NDArray[np.bool_]]] = []
    for number in cell.sources:
        pixels, valid = read_source(sources[number], cell, reader)
        if valid.mean() >= FULL_SHARE:
            return CellImage(_filled(pixels, valid), np.where(valid, number, -1).astype(np.int32))
        parts.append((number, pixels, valid))
    pixels = np.zeros((3, cell.size_px, cell.size_px), np.uint8)
    owner = np.full((cell.size_px, cell.size_px), -1, np.int32)
    for number, values, valid in parts:
        fresh = valid & (owner < 0)
        pixels[:, fresh], owner[fresh] = values[:, fresh], number
    valid = owner >= 0
    return CellImage(_filled(pixels, valid), owner) if valid.mean() >= FULL_SHARE else None


def _filled(values: NDArray[_Value], valid: NDArray[np.bool_]) -> NDArray[_Value]:
    """Gives every pixel that is not valid the values of the nearest one that is."""
    if valid.all() or not valid.any():
        return values
    # Around what is to be filled one ring of pixels is enough: none beyond it is nearer.
    rows, columns = (np.flatnonzero(~valid.all(axis)) for axis in (1, 0))
    part = np.s_[max(0, rows[0] - 1) : rows[-1] + 2, max(0, columns[0] - 1) : columns[-1] + 2]
    nearest = distance_transform_edt(~valid[part], return_distances=False, return_indices=True)
    filled = values.copy()
    filled[:, part[0], part[1]] = values[:, part[0], part[1]][:, nearest[0], nearest[1]]
    return filled


def read_source(
    source: Source, cell: Cell, reader: SourceReader
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Reads a cell out of one source: `[3, S, S]` bytes and `[S, S]` where it has data.

    Raises:
        ImageryError: the source cannot be read.
    """
    size = cell.size_px
    pixels = np.zeros((3, size, size), np.uint8)
    valid = np.zeros((size, size), np.bool_)
    shrink = max(cell.gsd_m / gsd for gsd in source.georeference.gsd_m)
    # Piece by piece, so that memory does not grow with the cell or the source's fineness.
    step = max(16, min(size, int(PIECE_PX / max(shrink, 1.0))))
    with reader.reading(source.path) as dataset:
        for top in range(0, size, step):
            for left in range(0, size, step):
                place = np.s_[..., top : top + step, left : left + step]
                _fill_piece(
                    dataset,
                    source,
                    cell,
                    cell.transform * Affine.translation(left, top),
                    pixels[place],
                    valid[place],
                )
    return pixels, valid


def _fill_piece(
    dataset: DatasetReader,
    source: Source,
    cell: Cell,
    transform: Affine,
    pixels: NDArray[np.uint8],
    valid: NDArray[np.bool_],
) -> None:
    """Fills a piece of a cell from a window of the source.

    `transform` takes the piece's pixels to coordinates.
    """
    shrink = max(cell.gsd_m / gsd for gsd in source.georeference.gsd_m)
    # What is needed of the source, with room for the resampling.
    window, inside = _window(
        source, cell, transform, pixels.shape[1:], margin_px=math.ceil(2 * max(shrink, 1.0)) + 2
    )
    if window is None:
        return
    bands = sorted({*source.bands})
    mask = read_mask(dataset, source, window)
    if not mask.any():
        return
    # The values as bytes, or as numbers on their scale; what is no number is no data.
    values = dataset.read(bands, window=window)
    if source.value_range is not None:
        low, high = source.value_range
        values = values.astype(np.float32)
        mask = np.where(np.isfinite(values).all(0), mask, 0).astype(np.uint8)
        values = np.clip((values - low) * (255 / (high - low)), 0, 255)
    placement = {
        "src_transform": source.georeference.transform
        * Affine.translation(window.col_off, window.row_off),
        "src_crs": source.georeference.crs or _NO_SYSTEM,
        "dst_transform": transform,
        "dst_crs": cell.crs or _NO_SYSTEM,
    }
    shrinking = shrink > SHRINKING_FROM
    # Where they are valid, taken to the ground.
    if inside and mask.all():
        valid[:] = True
    else:
        shares = np.zeros(valid.shape, np.uint8)
        reproject(
            mask,
            shares,
            resampling=Resampling.average if shrinking else Resampling.nearest,
            **placement,
        )
        valid[:] = shares >= 128
        if not valid.any():
            return
    # The colours, by the same way; at the edge of what is empty its values would be mixed in.
    values = _filled(values, mask > 0)
    warped = np.zeros((len(bands), *pixels.shape[1:]), values.dtype)
    reproject(
        values,
        warped,
        resampling=Resampling.average if shrinking else Resampling.cubic,
        **placement,
    )
    if warped.dtype != np.uint8:
        warped = (np.clip(warped, 0, 255) + 0.5).astype(np.uint8)
    pixels[:] = warped[[bands.index(band) for band in source.bands]]


def _window(
    source: Source, cell: Cell, transform: Affine, shape: tuple[int, ...], *, margin_px: int
) -> tuple[Window | None, bool]:
    """Returns the part of a source that shows a piece, and whether the source reaches around it."""
    border = [transform * point for point in outline(shape[1], shape[0])]
    places = to_reference_system(cell.crs, source.georeference.crs, border)
    if not all(math.isfinite(value) for place in places for value in place):
        return None, False
    inverse = ~source.georeference.transform
    pixels = [inverse * place for place in places]
    left = min(x for x, _ in pixels)
    right = max(x for x, _ in pixels)
    top = min(y for _, y in pixels)
    bottom = max(y for _, y in pixels)
    tiny = 1e-3
    inside = (
        left >= -tiny
        and top >= -tiny
        and right <= source.width_px + tiny
        and bottom <= source.height_px + tiny
    )
    first_column = max(0, math.floor(left) - margin_px)
    first_row = max(0, math.floor(top) - margin_px)
    last_column = min(source.width_px, math.ceil(right) + margin_px)
    last_row = min(source.height_px, math.ceil(bottom) + margin_px)
    if first_column >= last_column or first_row >= last_row:
        return None, False
    return Window(first_column, first_row, last_column - first_column, last_row - first_row), inside
