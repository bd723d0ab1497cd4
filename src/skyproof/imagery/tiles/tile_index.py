"""The places of a tiled folder's tiles: `index.geojson`, and cells read back from it."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from rasterio.crs import CRS
from rasterio.errors import CRSError

from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, ImageryError, StoredFileError
from skyproof.files import write_json
from skyproof.imagery.settings import TilingSettings
from skyproof.imagery.tiles.georeference import outline, to_reference_system
from skyproof.imagery.tiles.grid import Cell, Extent, extent_of
from skyproof.imagery.tiles.sources import Source
from skyproof.ranges import Coordinate, FileReference, Name
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import Split

GROUND_INDEX = "index.geojson"

_REMEDY = "copy the whole folder again, or cut the imagery again"
# Other names of systems, by PROJ and GDAL, are files and addresses.
_System = Annotated[str, Meta(pattern=r"\AEPSG:[0-9]{1,6}\Z")]


class _TileProperties(msgspec.Struct):
    """Properties of a tile; its bounds are left, bottom, right and top in its system."""

    id: Name
    file: FileReference
    split: Split
    source: str
    licence: str | None
    crs: _System
    bounds: tuple[Coordinate, Coordinate, Coordinate, Coordinate]


class _Polygon(msgspec.Struct):
    type: Literal["Polygon"]
    coordinates: list[list[tuple[Coordinate, Coordinate]]]


class _Feature(msgspec.Struct):
    type: Literal["Feature"]
    properties: _TileProperties
    geometry: _Polygon | None = None


class _Features(msgspec.Struct):
    """The file; members that map tools added to it are skipped."""

    type: Literal["FeatureCollection"]
    features: list[_Feature]


def write_ground_index(
    folder: Path, tiles: Sequence[BackgroundTile], cells: Mapping[str, Cell]
) -> None:
    """Writes `index.geojson`: one polygon per georeferenced tile, WGS 84 longitude and latitude."""
    features: list[_Feature] = []
    for tile in tiles:
        cell = cells[tile.id]
        if cell.crs is None:
            continue
        border = [cell.transform * point for point in outline(cell.size_px, cell.size_px, steps=1)]
        # GeoJSON runs anticlockwise, seen from above; rows of pixels run down.
        ring = to_reference_system(cell.crs, CRS.from_epsg(4326), [*reversed(border), border[-1]])
        facts = (tile.id, tile.file, tile.split, tile.source, tile.licence)
        properties = _TileProperties(*facts, cell.crs.to_string(), cell.extent)
        polygon = _Polygon("Polygon", [[(round(x, 9), round(y, 9)) for x, y in ring]])
        features.append(_Feature("Feature", properties, polygon))
    _write(folder, features)


def copy_ground_index(folder: Path, out: Path, kept: Collection[str]) -> None:
    """Writes the polygons of the kept tiles, if there are any, to another or the same folder."""
    if (Path(folder) / GROUND_INDEX).is_file():
        _write(out, [one for one in _read(folder) if one.properties.id in kept])


def _read_places(folder: Path) -> dict[str, tuple[CRS, Extent]]:
    """Reads the reference system and the extent of each georeferenced tile."""
    path = Path(folder) / GROUND_INDEX
    systems: dict[str, CRS] = {}
    places: dict[str, tuple[CRS, Extent]] = {}
    for feature in _read(folder):
        properties = feature.properties
        if properties.crs not in systems:
            try:
                systems[properties.crs] = CRS.from_string(properties.crs)
            except CRSError:
                raise StoredFileError(
                    f"{path} names the reference system {properties.crs}, which is not known; "
                    f"{_REMEDY}."
                ) from None
        left, bottom, right, top = properties.bounds
        if not (left < right and bottom < top):
            raise StoredFileError(
                f"{path} has no room between the bounds of {properties.id}; {_REMEDY}."
            )
        places[properties.id] = systems[properties.crs], properties.bounds
    return places


def _read(folder: Path) -> list[_Feature]:
    index: _Features = read_document(Path(folder) / GROUND_INDEX, _Features, _REMEDY)
    return index.features


def _write(folder: Path, features: Sequence[_Feature]) -> None:
    index = _Features("FeatureCollection", list(features))
    write_json(Path(folder) / GROUND_INDEX, msgspec.to_builtins(index))


def settings_like(settings: TilingSettings, folder: Path) -> TilingSettings:
    """Takes resolution and size from the tiled folder whose tiles are cut once more.

    Default values cannot be told from given ones, so that only others are compared. If the tiles
    have several sizes the largest is taken; each tile is cut in its own.
    """
    background_set = BackgroundSet.open(folder)
    usual = TilingSettings()
    gsd_m = background_set.gsd_m
    if settings.gsd_m not in (usual.gsd_m, gsd_m):
        raise ConfigurationError(
            f"--tiling.gsd-m expects the {gsd_m:g} m per pixel of {folder}, whose tiles "
            f"--tiling.like cuts again, got {settings.gsd_m:g}; leave it out."
        )
    sizes_px = sorted({tile.width_px for tile in background_set.all_tiles()})
    if settings.size_px not in (usual.size_px, *sizes_px):
        raise ConfigurationError(
            f"--tiling.size-px expects the {' or '.join(map(str, sizes_px))} px of the tiles of "
            f"{folder}, which --tiling.like cuts again, got {settings.size_px}; leave it out."
        )
    return dataclasses.replace(settings, gsd_m=gsd_m, size_px=max(sizes_px))


def cells_like(folder: Path, sources: Sequence[Source], notes: list[str]) -> list[Cell]:
    """Reads a tiled folder's georeferenced tiles as cells for other imagery of the same ground.

    Ids, places, sizes and splits are those of `folder`; cells that no source touches have none.
    """
    background_set = BackgroundSet.open(folder)
    placed = [i for i, source in enumerate(sources) if source.georeference.crs is not None]
    notes += [
        f"{source.path.name} does not say where it lies and is left out"
        for source in sources
        if source.georeference.crs is None
    ]
    cells: list[Cell] = []
    extents: dict[str, dict[int, Extent]] = {}
    for name, (crs, (left, bottom, right, top)) in _read_places(folder).items():
        tile = background_set.tile(name)
        system = crs.to_string()
        if system not in extents:
            extents[system] = {i: extent_of(sources[i], crs) for i in placed}
        touching = tuple(
            i
            for i, e in extents[system].items()
            if e[0] < right and e[2] > left and e[1] < top and e[3] > bottom
        )
        place = (crs, left, top, tile.width_px, background_set.gsd_m)
        cells.append(Cell(tile.id, *place, touching, tile.offset_px, split=tile.split))
    if not cells:
        raise ImageryError(
            f"The tiles of {folder} do not say where they lie; --tiling.like needs georeferenced "
            "ones."
        )
    if not any(cell.sources for cell in cells):
        raise ImageryError(
            f"None of the imagery shows ground of {folder}; check its place and reference system."
        )
    return cells
