"""Cuts orthophotos into tiles: a background set, and datasets if there are labels."""

import dataclasses
import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from msgspec import Meta

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.files import write_json
from skyproof.imagery.drivable import drivable_directions
from skyproof.imagery.flights import flights_of
from skyproof.imagery.labels.label import ImageLabels, Labels
from skyproof.imagery.photographs import lit_tiles, measure_sensor, some_of, sun_over
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.imagery.tiles.blocks import assign_splits
from skyproof.imagery.tiles.georeference import DEGREES, outline, to_reference_system
from skyproof.imagery.tiles.grid import Cell, cells_of, lay_grids
from skyproof.imagery.tiles.placed_labels import PlacedLabels
from skyproof.imagery.tiles.planes import inspect_imagery
from skyproof.imagery.tiles.sources import Source, SourceReader, notes_on
from skyproof.imagery.tiles.warp import CellImage, read_cell
from skyproof.ranges import Coordinate, FileReference, Name
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS, Split
from skyproof.words import counted, listed

GROUND_INDEX = "index.geojson"

_REMEDY = "copy the whole folder again, or cut the imagery again"
# Other names of systems, by PROJ and GDAL, are files and addresses.
_System = Annotated[str, Meta(pattern=r"\AEPSG:[0-9]{1,6}\Z")]

_WAITING = "waiting"


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


@dataclass(frozen=True)
class TilingRecord:
    """The content of `tiling.json`.

    `blocks_m` are the widths of the blocks of each grid, `counts` the tiles, vehicles and ignore
    regions of each split, and `empty` cells were left out because more than 2 % of them is empty.
    Notes on one image are of the kind `ImageNote`.
    """

    settings: dict[str, Any]
    sources: list[dict[str, Any]]
    blocks_m: dict[str, float]
    counts: dict[str, dict[str, int]]
    empty: int
    notes: list[str]


def tile_imagery(
    paths: Sequence[Path],
    folder: Path,
    *,
    settings: TilingSettings,
    generator: torch.Generator,
    source_settings: SourceSettings | None = None,
    labels: tuple[Labels, LabelSettings] | None = None,
    sources: Sequence[Source] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> TilingRecord:
    """Cuts orthophotos into a background set, and with labels into a dataset per split.

    Use `finished_folder` around it. Sources are read window by window: memory does not grow with
    them. The ground is cut into cells (`lay_grids`), a cell becomes a tile if sources show 98 % of
    it (`read_cell`), and blocks of cells go to the splits (`assign_splits`). Every place lies in
    one cell, so in one split, if images without georeference that show it are recognised
    (`inspect_imagery`). Vehicles are later drawn as sharp (`measure_sensor`) and as bright
    (`measure_exposure`) as the tiles. `labels` come with their vehicle classes, `sources` are the
    images of `paths` if they were inspected before, and `progress` gets (cells done, cells in all).

    Raises:
        ImageryError: an image is missing, unreadable, without resolution, or coarser than 50 cm;
            the images hold no tile; the labels do not fit them; a time is given for images without
            georeference, or the sun was down.
        RunFolderError: the disk cannot take it.
    """
    source_settings = source_settings or SourceSettings()
    tiles: list[BackgroundTile] = []
    annotations: dict[str, list[Annotation]] = {}
    sources = sources or inspect_imagery(paths, source_settings, labels and labels[0])
    with SourceReader() as reader:
        notes = notes_on(sources)
        every = (cell for grid in lay_grids(sources, settings, notes) for cell in cells_of(grid))
        cells = {cell.id: _labelled_first(cell, sources, labels and labels[0]) for cell in every}
        # An impossible time is refused before anything is cut.
        taken = source_settings.taken
        suns = {name: sun_over(cell, taken) for name, cell in cells.items() if taken}
        placed = None if labels is None else PlacedLabels(*labels, sources, [*cells.values()])
        notes += placed.notes if placed is not None else []
        flights = flights_of(sources)
        for done, cell in enumerate(cells.values(), 1):
            image = read_cell(cell, sources, reader)
            if image is not None:
                tile, annotations[cell.id] = _cut_tile(folder, cell, image, sources, placed)
                tiles.append(dataclasses.replace(tile, flight=flights[int(image.owner.max())]))
            progress(done, len(cells))
    # Too little imagery is refused before anything else is written.
    refuse_too_few(len(tiles), settings)
    splits, blocks_m = assign_splits(
        [cells[tile.id] for tile in tiles], settings.split_shares, generator=generator
    )
    without = [split for split in settings.split_shares if split not in splits.values()]
    if without:
        notes.append(f"too few tiles for {listed(without)}; give more imagery or a smaller size")
    tiles = _sorted_into_splits(folder, tiles, splits)
    if placed is not None:
        _write_datasets(folder, tiles, annotations, settings.gsd_m)
    backgrounds = BackgroundSet(folder, settings.gsd_m, tiles)
    sensor = _sensor(backgrounds, tiles, notes)
    middles_px = {name: [row.centre_px for row in rows] for name, rows in annotations.items()}
    tiles = lit_tiles(backgrounds, tiles, suns, middles_px, notes)
    record = TilingRecord(
        settings=_settings_record(settings, source_settings),
        sources=[_describe(source) for source in sources],
        blocks_m=blocks_m,
        counts=_counts(tiles, annotations),
        empty=len(cells) - len(tiles),
        notes=notes,
    )
    write_ground_index(folder, tiles, cells)
    write_json(folder / "tiling.json", vars(record))
    # The index comes last: a folder with one is whole.
    write_index(folder, settings.gsd_m, tiles, sensor)
    return record


def _labelled_first(cell: Cell, sources: Sequence[Source], labels: Labels | None) -> Cell:
    """Puts labelled photographs first among those of a cell, so that it is cut from one of them."""
    if cell.crs is not None or not isinstance(labels, ImageLabels):
        return cell
    order = sorted(cell.sources, key=lambda i: sources[i].path.stem not in labels.images)
    return dataclasses.replace(cell, sources=tuple(order))


def _cut_tile(
    folder: Path,
    cell: Cell,
    image: CellImage,
    sources: Sequence[Source],
    placed: PlacedLabels | None,
) -> tuple[BackgroundTile, list[Annotation]]:
    """Writes a cell's picture and map of drivable ground, and finds its labels."""
    rows: list[Annotation] = []
    vehicles = None
    if placed is not None:
        rows = placed.on(cell, image.owner)
        boxes = [row.box_xyxy for row in rows if not row.ignore]
        vehicles = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    pixels = torch.from_numpy(image.pixels)
    directions = drivable_directions(pixels, cell.gsd_m, vehicles)
    shown = [sources[number] for number in np.unique(image.owner[image.owner >= 0])]
    # A tile of several small images is named by their folders.
    small = len(shown) > 1 and all(source.smaller_side_m < cell.side_m for source in shown)
    names = (source.path.resolve().parent.name if small else source.path.name for source in shown)
    licences = dict.fromkeys(source.licence for source in shown if source.licence)
    _, row, column = cell.block
    tile = BackgroundTile(
        id=cell.id,
        file=f"{_WAITING}/{cell.id}.png",
        # The real split is known when all cells have been read.
        split=SPLITS[0],
        width_px=cell.size_px,
        height_px=cell.size_px,
        source=" + ".join(dict.fromkeys(names)),
        offset_px=(column * cell.size_px, row * cell.size_px),
        licence="; ".join(licences) or None,
        drivable=save_map(folder, "drivable", cell.id, directions),
    )
    save_tile(folder, tile, pixels)
    return tile, rows


def refuse_too_few(count: int, settings: TilingSettings) -> None:
    """Refuses imagery that yields no tile, or not one for each split where tiles may shrink."""
    least_px = settings.minimum_px or settings.size_px
    if not count:
        remedy = "" if settings.minimum_px else " or a smaller --tiling.size-px"
        raise ImageryError(
            f"No tile of {least_px * settings.gsd_m:.1f} m holds data: more than 2 % of each is "
            f"empty (nodata or beyond the border); give larger images{remedy}."
        )
    splits = len(settings.split_shares)
    if settings.minimum_px is not None and count < splits:
        raise ImageryError(
            f"The imagery yields {counted(count, 'tile')} of at least "
            f"{least_px * settings.gsd_m:.1f} m, and the {splits} splits need {splits}; give more "
            "or larger images."
        )


def _settings_record(settings: TilingSettings, source: SourceSettings) -> dict[str, Any]:
    of_source = dataclasses.asdict(source)
    named = dataclasses.asdict(settings) | {"source_gsd_m": of_source.pop("gsd_m")} | of_source
    return json.loads(json.dumps(named, default=str))


def _sensor(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile], notes: list[str]
) -> Sensor:
    """Measures blur and noise of some of the tiles; with too few edges the default is taken."""
    try:
        sensor = measure_sensor(backgrounds.pixels(tile.id) for tile in some_of(tiles))
    except ImageryError:
        notes.append(
            "too few clear edges to measure the blur; vehicles will be drawn with "
            f"{Sensor().blur_sigma_px} px"
        )
        return Sensor()
    notes.append(
        f"blur measured as {sensor.blur_sigma_px} px, noise as {sensor.noise}; vehicles will be "
        "drawn alike"
    )
    return sensor


def _sorted_into_splits(
    folder: Path, tiles: Sequence[BackgroundTile], splits: Mapping[str, Split]
) -> list[BackgroundTile]:
    """Moves the pictures into the folders of their splits."""
    for split in SPLITS:
        (folder / split / "images").mkdir(parents=True, exist_ok=True)
    moved = []
    for tile in tiles:
        file = f"{splits[tile.id]}/images/{tile.id}.png"
        (folder / tile.file).rename(folder / file)
        moved.append(dataclasses.replace(tile, file=file, split=splits[tile.id]))
    (folder / _WAITING).rmdir()
    return moved


def _write_datasets(
    folder: Path,
    tiles: Sequence[BackgroundTile],
    annotations: Mapping[str, Sequence[Annotation]],
    gsd_m: float,
) -> None:
    source = {"description": "skyproof tiles"}
    for split in SPLITS:
        with CocoWriter(folder / split, gsd_m=gsd_m, source=source) as writer:
            for tile in (one for one in tiles if one.split == split):
                writer.add_written(tile.id, (tile.width_px, tile.height_px), annotations[tile.id])


def _counts(
    tiles: Sequence[BackgroundTile], annotations: Mapping[str, Sequence[Annotation]]
) -> dict[str, dict[str, int]]:
    counts = {split: {"tiles": 0, "vehicles": 0, "ignored": 0} for split in map(str, SPLITS)}
    for tile in tiles:
        counts[tile.split]["tiles"] += 1
        for row in annotations[tile.id]:
            counts[tile.split]["ignored" if row.ignore else "vehicles"] += 1
    return counts


def _describe(source: Source) -> dict[str, Any]:
    georeference = source.georeference
    return {
        "name": source.path.name,
        "size_px": [source.width_px, source.height_px],
        "crs": None if georeference.crs is None else georeference.crs.to_string(),
        "gsd_m": [round(value, 6) for value in georeference.gsd_m],
        "bands": list(source.bands),
        "value_range": None if source.value_range is None else list(source.value_range),
        "nodata": None if source.nodata is None or math.isnan(source.nodata) else source.nodata,
        "licence": source.licence,
    }


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
