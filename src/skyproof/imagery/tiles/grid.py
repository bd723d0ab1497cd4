"""Lays the grids that tiles are cut on: one in true metres per stretch of connected imagery."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from affine import Affine
from rasterio.crs import CRS
from scipy.sparse.csgraph import connected_components

from skyproof.errors import ImageryError
from skyproof.imagery.tiles.georeference import (
    image_name,
    is_true_to_scale,
    outline,
    to_reference_system,
)
from skyproof.imagery.tiles.sources import Source
from skyproof.ranges import is_name
from skyproof.scenes.splits import Split

FULL_SHARE = 0.98
MOST_CELLS = 500_000
"""Tiles of one grid, as many as a thousand square kilometres have at the usual size."""
GLOBAL_FROM_TILES = 8
SHRINK = 0.8

Extent = tuple[float, float, float, float]
"""Left, bottom, right, top in a grid's metres."""


@dataclass(frozen=True)
class Cell:
    """A square of ground that may become a tile.

    Attributes:
        crs: of its coordinates; None in the grid of an image without georeference.
        left_m, top_m: its north-west corner.
        sources: which sources may show it, in the order in which they are asked.
        offset_px: its place in the grid, right and down.
        block: cells of one block go to one split.
        split: where it is settled beforehand.
    """

    id: str
    crs: CRS | None
    left_m: float
    top_m: float
    size_px: int
    gsd_m: float
    sources: tuple[int, ...]
    offset_px: tuple[int, int] = (0, 0)
    block: tuple[str, int, int] | None = None
    split: Split | None = None

    @property
    def extent(self) -> Extent:
        """Returns left, bottom, right, top."""
        side_m = self.size_px * self.gsd_m
        return self.left_m, self.top_m - side_m, self.left_m + side_m, self.top_m

    @property
    def transform(self) -> Affine:
        """Takes its pixels (column, row) to coordinates."""
        return Affine(self.gsd_m, 0.0, self.left_m, 0.0, -self.gsd_m, self.top_m)


@dataclass(frozen=True)
class Grid:
    """A grid in true metres.

    Attributes:
        name: begins the ids of its tiles.
        crs: its reference system; None for an image without georeference.
        left_m, top_m: the north-west corner of cell (0, 0).
        extents: per source that lies in it, by number, what it covers at most.
    """

    name: str
    crs: CRS | None
    left_m: float
    top_m: float
    size_px: int
    gsd_m: float
    extents: Mapping[int, Extent] = field(default_factory=dict)

    def places(self, extent: Extent, *, whole: bool) -> tuple[range, range]:
        """Returns columns and rows of the cells wholly within `extent`, or that touch it."""
        side_m = self.size_px * self.gsd_m
        slack = 0.5 * self.gsd_m / side_m * (1 if whole else -1)
        low, high = (math.ceil, math.floor) if whole else (math.floor, math.ceil)
        left, right = (
            (extent[0] - self.left_m) / side_m - slack,
            (extent[2] - self.left_m) / side_m + slack,
        )
        top, bottom = (
            (self.top_m - extent[3]) / side_m - slack,
            (self.top_m - extent[1]) / side_m + slack,
        )
        return range(low(left), high(right)), range(low(top), high(bottom))

    def whole_cells(self) -> int:
        """Counts about how many cells its sources fill, each alone or, where none can, together."""
        ranges = [self.places(extent, whole=True) for extent in self.extents.values()]
        alone = sum(len(columns) * len(rows) for columns, rows in ranges)
        return alone or len(self.filled)

    @cached_property
    def filled(self) -> dict[tuple[int, int], list[int]]:
        """Returns the cells that its sources together may fill: row and column to their numbers.

        Raises:
            ImageryError: they may be more than `MOST_CELLS`.
        """
        ranges = [self.places(extent, whole=False) for extent in self.extents.values()]
        count = sum(len(columns) * len(rows) for columns, rows in ranges)
        if count > MOST_CELLS:
            raise ImageryError(
                f"The imagery of grid {self.name} would become {count:,} tiles of {self.size_px} "
                f"px, more than {MOST_CELLS:,}; give fewer or smaller images, or larger tiles "
                "(--tiling.size-px)."
            )
        side_m = self.size_px * self.gsd_m
        seen: dict[tuple[int, int], list[int]] = {}
        covered: dict[tuple[int, int], float] = {}
        for number, extent in self.extents.items():
            columns, rows = self.places(extent, whole=False)
            for row in rows:
                top = self.top_m - row * side_m
                height = min(top, extent[3]) - max(top - side_m, extent[1])
                for column in columns:
                    left = self.left_m + column * side_m
                    width = min(left + side_m, extent[2]) - max(left, extent[0])
                    seen.setdefault((row, column), []).append(number)
                    covered[row, column] = covered.get((row, column), 0.0) + width * height
        enough = (FULL_SHARE - 0.005) * side_m**2
        return {place: seen[place] for place in sorted(seen) if covered[place] >= enough}


def plane_of(crs: CRS | None, sources: Sequence[int]) -> str:
    """Names the system a cell's coordinates belong to."""
    return f"source {sources[0]}" if crs is None else crs.to_string()


def extent_of(source: Source, crs: CRS | None) -> Extent:
    """Returns what a source covers at most in the system `crs`.

    Raises:
        ImageryError: the source lies outside what `crs` covers.
    """
    border = [
        source.georeference.transform * point
        for point in outline(source.width_px, source.height_px)
    ]
    points = to_reference_system(source.georeference.crs, crs, border)
    if not all(math.isfinite(value) for point in points for value in point):
        raise ImageryError(
            f"{source.path} lies outside what its reference system covers; check its system (or "
            "--source.crs)."
        )
    xs, ys = [x for x, _ in points], [y for _, y in points]
    return min(xs), min(ys), max(xs), max(ys)


def lay_grids(
    sources: Sequence[Source],
    *,
    size_px: int,
    minimum_px: int,
    wanted: int,
    gsd_m: float,
    notes: list[str],
) -> list[Grid]:
    """Lays grids over sources.

    Sources whose extents touch share a grid. Its system is that of its first source where a unit
    of it is a metre on the ground to 0.15 % (UTM, most national grids), so that imagery of the
    wanted resolution need not be resampled; otherwise the UTM zone of the grid's middle. Its cells
    lie at multiples of their size from the system's origin: whatever sheet shows a place, now or in
    another run, it falls in the same cell. Only imagery of fewer than eight cells across begins its
    grid at its own north-west corner, because it could not afford cut cells. An image without
    georeference has a grid of its own.

    Where cells are larger than `minimum_px` they shrink: in a grid that would hold none, and in
    all grids until there are as many as `wanted`, one per split.

    Raises:
        ImageryError: no grid holds a whole cell.
    """
    layouts = [_layout(sources, group) for group in _groups(sources)]
    size = size_px
    while True:
        grids = [
            _grid(name, crs, extents, size, minimum_px, gsd_m) for name, crs, extents in layouts
        ]
        if size <= minimum_px or sum(grid.whole_cells() for grid in grids) >= wanted:
            break
        size = max(minimum_px, round(size * SHRINK))
    kept = [grid for grid in grids if grid.whole_cells()]
    for grid in grids:
        if not grid.whole_cells():
            notes += [
                f"{sources[i].path.name} is too small for a tile of {grid.size_px} px; it is left "
                "out"
                for i in grid.extents
            ]
    if not kept:
        left, bottom, right, top = grids[0].extents[0]
        raise ImageryError(
            f"{sources[0].path} is {(right - left) / gsd_m:.0f} x {(top - bottom) / gsd_m:.0f} px "
            f"at {gsd_m} m per pixel, and no image holds a whole tile of {minimum_px} px; give "
            "larger images or a smaller size."
        )
    return kept


def _grid(
    name: str,
    crs: CRS | None,
    extents: Mapping[int, Extent],
    size_px: int,
    minimum_px: int,
    gsd_m: float,
) -> Grid:
    left = min(e[0] for e in extents.values())
    bottom = min(e[1] for e in extents.values())
    right = max(e[2] for e in extents.values())
    top = max(e[3] for e in extents.values())
    while True:
        narrow = min(right - left, top - bottom) < GLOBAL_FROM_TILES * size_px * gsd_m
        corner = (left, top) if crs is None or narrow else (0.0, 0.0)
        grid = Grid(name, crs, *corner, size_px, gsd_m, extents)
        if size_px <= minimum_px or grid.whole_cells():
            return grid
        size_px = max(minimum_px, round(size_px * SHRINK))


def _layout(
    sources: Sequence[Source], group: Sequence[int]
) -> tuple[str, CRS | None, dict[int, Extent]]:
    """Returns name, system and extents of the grid of sources that touch."""
    first = sources[group[0]]
    crs = first.georeference.crs
    if crs is None:
        return image_name(first.path).replace("/", "-"), None, {group[0]: extent_of(first, None)}
    middle = first.georeference.transform * (first.width_px / 2, first.height_px / 2)
    code = crs.to_epsg() if is_true_to_scale(crs, middle) else None
    if code is None:
        longitude, latitude = to_reference_system(crs, CRS.from_epsg(4326), [middle])[0]
        code = (32600 if latitude >= 0 else 32700) + min(60, int((longitude + 180) // 6) + 1)
    system = CRS.from_epsg(code)
    return f"epsg{code}", system, {i: extent_of(sources[i], system) for i in group}


def _groups(sources: Sequence[Source]) -> list[list[int]]:
    """Returns the numbers of sources whose extents in degrees touch, directly or through others."""
    degrees = CRS.from_epsg(4326)
    placed = [i for i, source in enumerate(sources) if source.georeference.crs is not None]
    extents = np.array([extent_of(sources[i], degrees) for i in placed]).reshape(-1, 4)
    low, high = extents[:, :2], extents[:, 2:]
    # Sheets that lie side by side leave gaps of rounding.
    gap = 1e-5
    touching = (low[:, None] <= high[None] + gap) & (low[None] <= high[:, None] + gap)
    pairs = np.eye(len(sources), dtype=bool)
    pairs[np.ix_(placed, placed)] |= touching.all(2)
    _, group_of = connected_components(pairs, directed=False)
    groups: dict[int, list[int]] = {}
    for i, group in enumerate(group_of):
        groups.setdefault(group, []).append(i)
    return list(groups.values())


def cells_of(grid: Grid) -> list[Cell]:
    """Lists the cells that the sources of a grid may fill, row by row, each a block of its own.

    Raises:
        ImageryError: they are more than `MOST_CELLS`, or no files can be called as they are.
    """
    side_m = grid.size_px * grid.gsd_m
    cells = []
    for (row, column), numbers in grid.filled.items():
        left_m, top_m = grid.left_m + column * side_m, grid.top_m - row * side_m
        offset_px = (column * grid.size_px, row * grid.size_px)
        if grid.crs is None:
            tile_id = f"{grid.name}-{offset_px[1]:05d}-{offset_px[0]:05d}"
        else:
            tile_id = f"{grid.name}-e{math.floor(left_m)}-n{math.floor(top_m)}"
        # A tile becomes a file of this name, which all commands read after this one.
        if not is_name(f"{tile_id}.png"):
            raise ImageryError(
                "Tiles of an image without georeference bear its name, which expects at most 130 "
                f"characters, no ':', no backslash and no line break, got {grid.name!r}; rename "
                "the image."
            )
        sources = tuple(sorted(numbers))
        block = (grid.name, row, column)
        cells.append(
            Cell(
                tile_id,
                grid.crs,
                left_m,
                top_m,
                grid.size_px,
                grid.gsd_m,
                sources,
                offset_px,
                block,
            )
        )
    return cells
