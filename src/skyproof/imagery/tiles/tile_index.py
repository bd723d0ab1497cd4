"""The places of a tiled folder's tiles: `index.geojson`."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.imagery.tiles.georeference import DEGREES, outline, to_reference_system
from skyproof.imagery.tiles.grid import Cell
from skyproof.ranges import Coordinate, FileReference, Name
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.splits import Split

GROUND_INDEX = "index.geojson"

_REMEDY = "copy the whole folder again, or cut the imagery again"
# Other names of systems, by PROJ and GDAL, are files and addresses.
_System = Annotated[str, Meta(pattern=r"\AEPSG:[0-9]{1,6}\Z")]


class _TileProperties(msgspec.Struct):
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
        ring = to_reference_system(cell.crs, DEGREES, [*reversed(border), border[-1]])
        facts = (tile.id, tile.file, tile.split, tile.source, tile.licence)
        properties = _TileProperties(*facts, cell.crs.to_string(), cell.extent)
        polygon = _Polygon("Polygon", [[(round(x, 9), round(y, 9)) for x, y in ring]])
        features.append(_Feature("Feature", properties, polygon))
    _write(folder, features)


def copy_ground_index(folder: Path, out: Path, kept: Collection[str]) -> None:
    """Writes the polygons of the kept tiles, if there are any, to another or the same folder."""
    path = Path(folder) / GROUND_INDEX
    if path.is_file():
        index: _Features = read_document(path, _Features, _REMEDY)
        _write(out, [one for one in index.features if one.properties.id in kept])


def _write(folder: Path, features: Sequence[_Feature]) -> None:
    index = _Features("FeatureCollection", list(features))
    write_json(Path(folder) / GROUND_INDEX, msgspec.to_builtins(index))
