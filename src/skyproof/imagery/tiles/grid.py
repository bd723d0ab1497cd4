"""Lays the grids that tiles are cut on."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from affine import Affine
from rasterio.crs import CRS
from scipy.cluster.hierarchy import DisjointSet
from shapely import Polygon

from skyproof.errors import ImageryError
from skyproof.imagery.notes import ImageNote
from skyproof.imagery.settings import TilingSettings
from skyproof.imagery.tiles.georeference import (
    DEGREES,
    is_true_to_scale,
    outline,
    to_reference_system,
)
from skyproof.imagery.tiles.sources import Source
from skyproof.imagery.tiles.whole_cells import outline_of, shown_whole
from skyproof.ranges import is_name
from skyproof.scenes.backgrounds import room_to_turn_rad
from skyproof.words import counted, named, span

FULL_SHARE = 0.98
NEARLY = 0.95
"""Larger tiles are preferred if they use this share of the most ground that any tiles use."""
MOST_CELLS = 500_000
"""Tiles of one grid, as many as a thousand square kilometres have at the usual size."""
GLOBAL_FROM_TILES = 8
SHRINK = 0.8
MOST_CORNERS = 32
"""Photographs of a plane whose corners are tried as that of the grid."""

BlockKey = tuple[str, int, int]

Extent = tuple[float, float, float, float]
"""Left, bottom, right, top in a grid's metres."""


@dataclass(frozen=True)
class Cell:
    """A square of ground that may become a tile.

    `sources` are the numbers of the sources that may show it, in order of precedence. `block` is
    the grid's name, the row and the column.
    """

    id: str
    crs: CRS | None
    left_m: float
    top_m: float
    size_px: int
    gsd_m: float
    sources: tuple[int, ...]
    block: BlockKey

    @property
    def plane(self) -> str:
        """The name of the system of its coordinates."""
        return f"plane of {self.block[0]}" if self.crs is None else self.crs.to_string()

    @property
    def side_m(self) -> float:
        return self.size_px * self.gsd_m

    @property
    def extent(self) -> Extent:
        return self.left_m, self.top_m - self.side_m, self.left_m + self.side_m, self.top_m

    @property
    def transform(self) -> Affine:
        """The transform from its pixels (column, row) to coordinates."""
        return Affine(self.gsd_m, 0.0, self.left_m, 0.0, -self.gsd_m, self.top_m)


@dataclass(frozen=True)
class Grid:
    """A grid in true metres from the north-west corner of cell (0, 0), over numbered sources.

    Photographs in one plane have `outlines`: each cell comes whole from one of them.
    """

    name: str
    crs: CRS | None
    left_m: float
    top_m: float
    size_px: int
    gsd_m: float
    extents: Mapping[int, Extent]
    outlines: Mapping[int, Polygon] = field(default_factory=dict)

    @property
    def side_m(self) -> float:
        return self.size_px * self.gsd_m

    def places(self, extent: Extent, *, whole: bool) -> tuple[range, range]:
        """Returns columns and rows of the cells wholly within `extent`, or that touch it."""
        slack = 0.5 * self.gsd_m / self.side_m * (1 if whole else -1)
        low, high = (math.ceil, math.floor) if whole else (math.floor, math.ceil)
        left, bottom, right, top = extent
        across = left - self.left_m, right - self.left_m
        down = self.top_m - top, self.top_m - bottom
        columns, rows = (
            range(low(first / self.side_m - slack), high(last / self.side_m + slack))
            for first, last in (across, down)
        )
        return columns, rows

    def whole_cells(self) -> int:
        """Counts the cells that single sources fill, or else those that all fill together."""
        if self.outlines:
            return len(self.filled)
        ranges = [self.places(extent, whole=True) for extent in self.extents.values()]
        alone = sum(len(columns) * len(rows) for columns, rows in ranges)
        return alone or len(self.filled)

    @cached_property
    def filled(self) -> dict[tuple[int, int], list[int]]:
        """The cells that its sources together may fill: row and column to their numbers."""
        places = {i: self.places(extent, whole=False) for i, extent in self.extents.items()}
        count = sum(len(columns) * len(rows) for columns, rows in places.values())
        if count > MOST_CELLS:
            raise ImageryError(
                f"The imagery of grid {self.name} would become {count:,} tiles of {self.size_px} "
                f"px, more than {MOST_CELLS:,}; give fewer or smaller images, or larger tiles "
                "(--tiling.size-px)."
            )
        if self.outlines:
            corner, slack_m = (self.left_m, self.top_m), 0.5 * self.gsd_m
            return shown_whole(self.outlines, places, corner, self.side_m, slack_m)
        side_m = self.side_m
        seen: dict[tuple[int, int], list[int]] = {}
        covered: dict[tuple[int, int], float] = {}
        for number, (columns, rows) in places.items():
            left, bottom, right, top = self.extents[number]
            for row, column in itertools.product(rows, columns):
                west, north = self.left_m + column * side_m, self.top_m - row * side_m
                width = min(west + side_m, right) - max(west, left)
                height = min(north, top) - max(north - side_m, bottom)
                seen.setdefault((row, column), []).append(number)
                covered[row, column] = covered.get((row, column), 0.0) + width * height
        enough = (FULL_SHARE - 0.005) * side_m**2
        return {place: seen[place] for place in sorted(seen) if covered[place] >= enough}


def around(extents: Iterable[Extent]) -> Extent:
    """Returns the smallest extent around others."""
    lefts, bottoms, rights, tops = zip(*extents, strict=True)
    return min(lefts), min(bottoms), max(rights), max(tops)


def extent_of(source: Source, crs: CRS | None) -> Extent:
    """Returns the extent of a source in the system `crs`."""
    transform = source.georeference.transform
    border = [transform * point for point in outline(source.width_px, source.height_px)]
    points = to_reference_system(source.georeference.crs, crs, border)
    if not all(math.isfinite(value) for point in points for value in point):
        raise ImageryError(
            f"{source.path} lies outside what its reference system covers; check its system (or "
            "--source.crs)."
        )
    return around((x, y, x, y) for x, y in points)


def lay_grids(sources: Sequence[Source], settings: TilingSettings, notes: list[str]) -> list[Grid]:
    """Lays a grid over each group of sources that touch; refuses sources without a whole cell.

    The system is that of the first source if a unit there is a metre on the ground, so that imagery
    need not be resampled, and otherwise the UTM zone. Cells lie at multiples of their size, so that
    a place falls in the same cell in every run, except in imagery of fewer than eight cells across.
    Cells shrink until there is one for each split, but not below `turning_px`. If sources hold no
    such cell, or all together too few, cells shrink further, to the size that uses the most ground.
    """
    unlaid = [_unlaid(sources, group, settings) for group in _groups(sources)]
    alone = sum(source.georeference.crs is None for source in sources)
    if alone > 1:
        places = sum(grid.crs is None for grid in unlaid)
        notes.append(
            f"{alone} images without georeference show at most {counted(places, 'distinct place')}"
        )
    size, gsd_m = settings.size_px, settings.gsd_m
    wanted = len(settings.split_shares)
    while True:
        grids = [_laid(grid, size, settings.turning_px) for grid in unlaid]
        few = sum(grid.whole_cells() for grid in grids) < wanted
        if size <= settings.turning_px or not few:
            break
        size = max(settings.turning_px, round(size * SHRINK))
    least_px = settings.minimum_px or size
    if least_px < settings.turning_px:
        grids = [
            _shrunk(grid, least_px, few=few) if few or not grid.whole_cells() else grid
            for grid in grids
        ]
    kept = [grid for grid in grids if grid.whole_cells()]
    if not kept:
        left, bottom, right, top = grids[0].extents[0]
        remedy = "" if settings.minimum_px else " or a smaller --tiling.size-px"
        raise ImageryError(
            f"{sources[0].path} shows {right - left:.1f} x {top - bottom:.1f} m, and no image "
            f"holds a whole tile, which takes {least_px * gsd_m:.1f} m on each side ({least_px} px "
            f"of {gsd_m:g} m); give larger images{remedy}."
        )
    small = f"too small for a tile of {least_px * gsd_m:.1f} m, and left out"
    notes += [
        ImageNote(sources[i].path.name, small)
        for grid in grids
        if not grid.whole_cells()
        for i in grid.extents
    ]
    notes += _tight_notes(kept, sources, settings)
    return kept


def _tight_notes(
    grids: Sequence[Grid], sources: Sequence[Source], settings: TilingSettings
) -> Iterator[str]:
    """Yields a note on tiles in which scenes cannot turn freely."""
    tight = [grid for grid in grids if grid.size_px < settings.turning_px]
    if tight and settings.minimum_px is not None:
        names = [sources[i].path.name for grid in tight for i in grid.extents]
        sides_px = [grid.size_px for grid in tight]
        turn_deg = math.degrees(room_to_turn_rad(settings.minimum_px, max(sides_px)))
        scene_m, free_m = (px * settings.gsd_m for px in (settings.minimum_px, settings.turning_px))
        yield (
            f"tiles of {span(min(sides_px) * settings.gsd_m, max(sides_px) * settings.gsd_m, 1)} m "
            f"from {named(names, 'image')}: scenes of {scene_m:.1f} m are turned there by at most "
            f"{turn_deg:.0f} degrees off the sides of a tile (freely from {free_m:.1f} m on), so "
            "the result covers fewer views of this ground"
        )


def _laid(grid: Grid, size_px: int, minimum_px: int) -> Grid:
    """Lays a grid with cells of this size, or of the next smaller one that gives whole cells."""
    left, bottom, right, top = around(grid.extents.values())
    while True:
        narrow = min(right - left, top - bottom) < GLOBAL_FROM_TILES * size_px * grid.gsd_m
        left_m, top_m = (left, top) if grid.crs is None or narrow else (0.0, 0.0)
        grid = replace(grid, left_m=left_m, top_m=top_m, size_px=size_px)
        if grid.outlines:
            grid = max(_from_corners(grid), key=Grid.whole_cells)
        if size_px <= minimum_px or grid.whole_cells():
            return grid
        size_px = max(minimum_px, round(size_px * SHRINK))


def _from_corners(grid: Grid) -> Iterator[Grid]:
    """Yields the grid laid from its photographs' corners in turn, as it would lie on each alone.

    Cell (0, 0) stays at the north-west of all of them.
    """
    side_m, extents = grid.side_m, [*grid.extents.values()]
    left, _, _, top = around(extents)
    for its_left, _, _, its_top in extents[:: math.ceil(len(extents) / MOST_CORNERS)]:
        columns, rows = math.ceil((its_left - left) / side_m), math.ceil((top - its_top) / side_m)
        corner = its_left - columns * side_m, its_top + rows * side_m
        yield replace(grid, left_m=corner[0], top_m=corner[1])


def _shrunk(grid: Grid, least_px: int, *, few: bool) -> Grid:
    """Shrinks cells to the largest size that uses nearly as much ground as any size does.

    With `few` the number of cells counts instead. No cell is smaller than `least_px`.
    """
    sides_px = [
        side_m / grid.gsd_m
        for left, bottom, right, top in grid.extents.values()
        for side_m in (right - left, top - bottom)
    ]
    # Where a side holds a whole number of cells, with the slack of `places`.
    sizes = {
        int((side_px + 0.5) / number)
        for side_px in sides_px
        for number in range(1, int((side_px + 0.5) / least_px) + 1)
    }
    smaller = [size for size in sorted(sizes) if least_px <= size < grid.size_px]
    grids = [*(_laid(grid, size, size) for size in smaller), grid]
    worth = [each.whole_cells() * (1.0 if few else each.side_m**2) for each in grids]
    return [each for each, it in zip(grids, worth, strict=True) if it >= NEARLY * max(worth)][-1]


def _unlaid(sources: Sequence[Source], group: Sequence[int], settings: TilingSettings) -> Grid:
    """Returns the grid of sources that touch, before its corner and size are chosen."""
    first = sources[group[0]]
    crs, unlaid = first.georeference.crs, (0.0, 0.0, settings.size_px, settings.gsd_m)
    if crs is None:
        extents = {i: extent_of(sources[i], None) for i in group}
        shared = {i: outline_of(sources[i]) for i in group} if len(group) > 1 else {}
        return Grid(first.path.stem, None, *unlaid, extents, shared)
    middle = first.georeference.transform * (first.width_px / 2, first.height_px / 2)
    code = crs.to_epsg() if is_true_to_scale(crs, middle) else None
    if code is None:
        longitude, latitude = to_reference_system(crs, DEGREES, [middle])[0]
        code = (32600 if latitude >= 0 else 32700) + min(60, int((longitude + 180) // 6) + 1)
    system = CRS.from_epsg(code)
    extents = {i: extent_of(sources[i], system) for i in group}
    return Grid(f"epsg{code}", system, *unlaid, extents)


def _groups(sources: Sequence[Source]) -> list[list[int]]:
    """Groups the numbers of sources that touch, directly or through others, or share a plane.

    Georeferenced ones touch by their extents in degrees.
    """
    placed = [i for i, source in enumerate(sources) if source.georeference.crs is not None]
    extents = np.array([extent_of(sources[i], DEGREES) for i in placed]).reshape(-1, 4)
    low, high = extents[:, :2], extents[:, 2:]
    # Rounding leaves gaps between map sheets that lie side by side.
    gap = 1e-5
    touching = (low[:, None] <= high[None] + gap) & (low[None] <= high[:, None] + gap)
    groups = DisjointSet(range(len(sources)))
    for one, other in np.argwhere(touching.all(2)):
        groups.merge(placed[one], placed[other])
    first_of: dict[str, int] = {}
    for i, source in enumerate(sources):
        if source.georeference.plane is not None:
            groups.merge(first_of.setdefault(source.georeference.plane, i), i)
    return [sorted(group) for group in groups.subsets()]


def cells_of(grid: Grid) -> list[Cell]:
    """Lists the cells that the sources of a grid may fill, row by row, each a block of its own."""
    cells = []
    blocks = grid.name
    if grid.crs is not None and (grid.left_m or grid.top_m):
        # Rows and columns from the grid's own corner mean other places in another grid.
        blocks = f"{grid.name}-e{math.floor(grid.left_m)}-n{math.floor(grid.top_m)}"
    for (row, column), numbers in grid.filled.items():
        left_m, top_m = grid.left_m + column * grid.side_m, grid.top_m - row * grid.side_m
        if grid.crs is None:
            tile_id = f"{grid.name}-{row * grid.size_px:05d}-{column * grid.size_px:05d}"
        else:
            tile_id = f"{grid.name}-e{math.floor(left_m)}-n{math.floor(top_m)}"
        # A tile becomes a file of this name, which all commands read after this one.
        if not is_name(f"{tile_id}.png"):
            raise ImageryError(
                "Tiles of an image without georeference bear its name, which expects at most 130 "
                f"characters, no ':', no backslash and no line break, got {grid.name!r}; rename "
                "the image."
            )
        place = (tile_id, grid.crs, left_m, top_m, grid.size_px, grid.gsd_m)
        cells.append(Cell(*place, tuple(numbers), (blocks, row, column)))
    return cells
