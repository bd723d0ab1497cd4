"""Resamples cells of ground in true metres, anti-aliased."""

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
from skyproof.imagery.tiles.sources import Source, SourceReader, holds_data, read_mask

SHRINKING_FROM = 1.1
PIECE_PX = 2048
_TINY_PX = 1e-3

_Value = TypeVar("_Value", bound=np.generic)

# Any system serves if both sides are in the same one.
_NO_SYSTEM = CRS.from_epsg(32631)


@dataclass(frozen=True)
class CellImage:
    """The picture of a cell, `[3, S, S]`, and the number of each pixel's source, -1 if empty."""

    pixels: NDArray[np.uint8]
    owner: NDArray[np.int32]


def read_cell(cell: Cell, sources: Sequence[Source], reader: SourceReader) -> CellImage | None:
    """Reads a cell from its sources; None if they fill less than 98 % of it.

    The first source that fills so much provides the whole cell; otherwise each source fills what
    those before it left. Empty pixels take the nearest colour, because a detector would learn from
    black edges. Overviews inside the files are not used, because many were point-sampled.
    """
    pixels = np.zeros((3, cell.size_px, cell.size_px), np.uint8)
    owner = np.full((cell.size_px, cell.size_px), -1, np.int32)
    for number in cell.sources:
        values, valid = read_source(sources[number], cell, reader)
        if valid.mean() >= FULL_SHARE:
            return CellImage(_filled(values, valid), np.where(valid, number, -1).astype(np.int32))
        fresh = valid & (owner < 0)
        pixels[:, fresh], owner[fresh] = values[:, fresh], number
    valid = owner >= 0
    return CellImage(_filled(pixels, valid), owner) if valid.mean() >= FULL_SHARE else None


def _filled(values: NDArray[_Value], valid: NDArray[np.bool_]) -> NDArray[_Value]:
    """Returns the values, with those of the nearest valid pixel in every invalid one."""
    if valid.all() or not valid.any():
        return values
    # One ring around the invalid pixels is enough: none beyond it is nearer.
    rows, columns = (np.flatnonzero(~valid.all(axis)) for axis in (1, 0))
    part = np.s_[max(0, rows[0] - 1) : rows[-1] + 2, max(0, columns[0] - 1) : columns[-1] + 2]
    nearest = distance_transform_edt(~valid[part], return_distances=False, return_indices=True)
    filled = values.copy()
    filled[:, part[0], part[1]] = values[:, part[0], part[1]][:, nearest[0], nearest[1]]
    return filled


def read_source(
    source: Source, cell: Cell, reader: SourceReader
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Reads a cell from one source: `[3, S, S]` bytes, and `[S, S]` whether it has data."""
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
                transform = cell.transform * Affine.translation(left, top)
                _fill_piece(dataset, source, cell, transform, pixels[place], valid[place])
    return pixels, valid


def _fill_piece(
    dataset: DatasetReader,
    source: Source,
    cell: Cell,
    transform: Affine,
    pixels: NDArray[np.uint8],
    valid: NDArray[np.bool_],
) -> None:
    """Fills a piece of a cell; `transform` maps its pixels to coordinates."""
    shrink = max(cell.gsd_m / gsd for gsd in source.georeference.gsd_m)
    # The resampling needs a margin.
    margin_px = math.ceil(2 * max(shrink, 1.0)) + 2
    window, inside = _window(source, cell, transform, pixels.shape[1:], margin_px)
    if window is None:
        return
    bands = sorted({*source.bands})
    mask = read_mask(dataset, source, window)
    if not mask.any():
        return
    values = dataset.read(bands, window=window)
    if source.value_range is not None:
        low, high = source.value_range
        values = values.astype(np.float32)
        mask = np.where(holds_data(values), mask, 0).astype(np.uint8)
        values = np.clip((values - low) * (255 / (high - low)), 0, 255)
    corner = Affine.translation(window.col_off, window.row_off)
    placement = {
        "src_transform": source.georeference.transform * source.stored * corner,
        "src_crs": source.georeference.crs or _NO_SYSTEM,
        "dst_transform": transform,
        "dst_crs": cell.crs or _NO_SYSTEM,
    }
    shrinking = shrink > SHRINKING_FROM
    valid[:] = True
    if not (inside and mask.all()):
        shares = np.zeros(valid.shape, np.uint8)
        method = Resampling.average if shrinking else Resampling.nearest
        reproject(mask, shares, resampling=method, **placement)
        valid[:] = shares >= 128
        if not valid.any():
            return
    # Values of empty pixels would be mixed in at their edges.
    values = _filled(values, mask > 0)
    warped = np.zeros((len(bands), *pixels.shape[1:]), values.dtype)
    method = Resampling.average if shrinking else Resampling.cubic
    reproject(values, warped, resampling=method, **placement)
    if warped.dtype != np.uint8:
        warped = (np.clip(warped, 0, 255) + 0.5).astype(np.uint8)
    pixels[:] = warped[[bands.index(band) for band in source.bands]]


def _window(
    source: Source, cell: Cell, transform: Affine, shape: tuple[int, ...], margin_px: int
) -> tuple[Window | None, bool]:
    """Returns the part of a source that shows a piece, and whether the source reaches around it."""
    border = [transform * point for point in outline(shape[1], shape[0])]
    places = to_reference_system(cell.crs, source.georeference.crs, border)
    if not np.isfinite(places).all():
        return None, False
    inverse = ~(source.georeference.transform * source.stored)
    pixels = np.array([inverse * place for place in places])
    low, high = pixels.min(0), pixels.max(0)
    upright_px = source.width_px, source.height_px
    size_px = np.array(upright_px[::-1] if source.stored.b else upright_px)
    inside = bool((low >= -_TINY_PX).all() and (high <= size_px + _TINY_PX).all())
    first = np.maximum(0, np.floor(low).astype(int) - margin_px)
    count = np.minimum(size_px, np.ceil(high).astype(int) + margin_px) - first
    if (count <= 0).any():
        return None, False
    return Window(*first.tolist(), *count.tolist()), inside
