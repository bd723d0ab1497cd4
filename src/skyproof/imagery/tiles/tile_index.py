"""Says where a tiled folder's tiles lie: `index.geojson`, and cells read back from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rasterio.crs import CRS

from skyproof.errors import ImageryError, StoredFileError
from skyproof.files import read_json, write_json
from skyproof.imagery.tiles.georeference import outline, to_reference_system
from skyproof.imagery.tiles.grid import Cell, extent_of
from skyproof.imagery.tiles.sources import Source
from skyproof.scenes.backgrounds import BackgroundSet, BackgroundTile

__all__ = ["cells_like", "write_ground_index"]


def write_ground_index(
    folder: Path, tiles: Sequence[BackgroundTile], cells: Mapping[str, Cell]
) -> None:
    """Writes `index.geojson`: one polygon per georeferenced tile, WGS 84 longitude and latitude.

    Properties: id, file, split, source, licence, crs, bounds (left, bottom, right, top in crs).
    """
    features = []
    for tile in tiles:
        cell = cells[tile.id]
        if cell.crs is None:
            continue
        border = [cell.transform * point for point in outline(cell.size_px, cell.size_px, steps=1)]
        # GeoJSON runs anticlockwise, seen from above; rows of pixels run down.
        ring = to_reference_system(cell.crs, CRS.from_epsg(4326), [*reversed(border), border[-1]])
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "id": tile.id,
                    "file": tile.file,
                    "split": tile.split,
                    "source": tile.source,
                    "licence": tile.licence,
                    "crs": cell.crs.to_string(),
                    "bounds": list(cell.extent),
                },
                "geometry": {
                    "type": "Polygon",
                    "coordinates": [[[round(x, 9), round(y, 9)] for x, y in ring]],
                },
            }
        )
    write_json(Path(folder) / "index.geojson", {"type": "FeatureCollection", "features": features})


def cells_like(folder: Path, sources: Sequence[Source], notes: list[str]) -> list[Cell]:
    """Reads a tiled folder's georeferenced tiles as cells for other imagery of the same ground.

    Ids, places, sizes and splits are those of `folder`; tiles that no source touches are among
    them, without sources.

    Raises:
        StoredFileError: `folder` is not a tiled folder.
        ImageryError: its tiles, or no source, have a place on the ground.
    """
    background_set = BackgroundSet.open(folder)
    path = Path(folder) / "index.geojson"
    document = read_json(path)
    placed = [i for i, source in enumerate(sources) if source.georeference.crs is not None]
    notes += [
        f"{source.path.name} does not say where it lies and is left out"
        for source in sources
        if source.georeference.crs is None
    ]
    cells: list[Cell] = []
    extents: dict[str, dict[int, tuple[float, float, float, float]]] = {}
    try:
        for feature in document["features"]:
            properties: dict[str, Any] = feature["properties"]
            tile = background_set.tile(properties["id"])
            name = str(properties["crs"])
            left, bottom, right, top = (float(value) for value in properties["bounds"])
            crs = CRS.from_user_input(name)
            if name not in extents:
                extents[name] = {i: extent_of(sources[i], crs) for i in placed}
            touching = tuple(
                i
                for i, e in extents[name].items()
                if e[0] < right and e[2] > left and e[1] < top and e[3] > bottom
            )
            cells.append(
                Cell(
                    id=tile.id,
                    crs=crs,
                    left_m=left,
                    top_m=top,
                    size_px=tile.width_px,
                    gsd_m=background_set.gsd_m,
                    sources=touching,
                    offset_px=tile.offset_px,
                    split=tile.split,
                )
            )
    except (KeyError, TypeError, ValueError) as error:
        raise StoredFileError(
            f"{path} is not an index of ours ({error!r}); tile the imagery again."
        ) from error
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
