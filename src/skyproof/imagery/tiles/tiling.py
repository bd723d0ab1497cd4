"""Cuts orthophotos into tiles: a background set, and datasets if there are labels."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.errors import ImageryError
from skyproof.files import write_json
from skyproof.imagery.drivable import drivable_directions
from skyproof.imagery.exposure import lit_tiles, some_of, sun_over
from skyproof.imagery.labels.label import Labels
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.imagery.sharpness import measure_sensor
from skyproof.imagery.tiles.grid import Cell, assign_splits, cells_of, lay_grids
from skyproof.imagery.tiles.placed_labels import PlacedLabels
from skyproof.imagery.tiles.sources import Source, SourceReader, find_images, inspect_source
from skyproof.imagery.tiles.tile_index import write_ground_index
from skyproof.imagery.tiles.warp import CellImage, read_cell
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS, Split

_WAITING = "waiting"
_SAME_NOTES = 8


@dataclass(frozen=True)
class TilingRecord:
    """The content of `tiling.json`.

    Attributes:
        blocks_m: width of the blocks of each grid.
        counts: numbers of tiles, vehicles and ignore regions of each split.
        empty: number of cells left out because more than 2 % of them is empty.
        notes: sentences about assumptions, repairs, and images or labels that were left out.
    """

    settings: dict[str, Any]
    sources: list[dict[str, Any]]
    blocks_m: dict[str, float]
    counts: dict[str, dict[str, int]]
    empty: int
    notes: list[str]


@dataclass
class _Cut:
    """The cells of the sources, and the tiles that were cut from them."""

    folder: Path
    settings: TilingSettings
    sources: list[Source]
    cells: list[Cell]
    notes: list[str]
    kept: dict[str, Cell] = field(default_factory=dict)
    tiles: list[BackgroundTile] = field(default_factory=list)
    annotations: dict[str, list[Annotation]] = field(default_factory=dict)


def tile_imagery(
    paths: Sequence[Path],
    folder: Path,
    *,
    settings: TilingSettings,
    generator: torch.Generator,
    source_settings: SourceSettings | None = None,
    labels: tuple[Labels, LabelSettings] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TilingRecord:
    """Cuts orthophotos into a background set, and with labels into a dataset per split.

    It writes `index.json`, `index.geojson`, `<split>/images/*.png`, `drivable/*.png` and
    `tiling.json`. Use `finished_folder` around it.

    Sources are read window by window: memory does not grow with them. The ground is cut into cells
    (`lay_grids`), a cell becomes a tile if sources show 98 % of it (`read_cell`), and blocks of
    cells go to the splits (`assign_splits`). Every place of georeferenced sources lies in one cell,
    so in one split, however many of them show it. Images without georeference that show the same
    ground, such as frames of a flight, cannot be told apart from others: splits may then share it.

    Blur and noise of the tiles are measured, so that vehicles are drawn as sharp as they are
    (`measure_sensor`), and the exposure of each source, so that they are as bright
    (`measure_exposure`). A simple rule finds drivable ground (`drivable_directions`).

    With labels every split also gets `annotations.json`, so that its folder is a dataset to train
    on. Tiles without any vehicle stay.

    Args:
        paths: images, or folders of images; sub-folders are not searched.
        labels: the labels, and their classes that count as vehicles.
        progress: called with (cells done, cells in all).

    Raises:
        ImageryError: an image is missing, unreadable, without resolution, or coarser than 50 cm;
            the images hold no tile; the labels do not fit them; a time is given for images without
            georeference, or the sun was down.
        RunFolderError: the disk cannot take it.
    """
    source_settings = source_settings or SourceSettings()
    files = find_images(paths)
    with SourceReader() as reader:
        sources = [inspect_source(path, source_settings, reader) for path in files]
        notes = _notes(sources)
        grids = lay_grids(sources, settings, notes)
        cells = [cell for grid in grids for cell in cells_of(grid)]
        cut = _Cut(folder, settings, sources, cells, notes)
        # An impossible time is refused before anything is cut.
        taken = source_settings.taken
        suns = {cell.id: sun_over(cell, taken) for cell in cells if taken}
        placed = None if labels is None else PlacedLabels(*labels, sources, cut.cells)
        notes += placed.notes if placed is not None else []
        for done, cell in enumerate(cut.cells, 1):
            _cut_cell(cut, cell, placed, reader)
            if progress is not None:
                progress(done, len(cut.cells))
    # Too little imagery is refused before anything else is written.
    _refuse_too_few(len(cut.tiles), settings)
    splits, blocks_m = assign_splits(
        [*cut.kept.values()], settings.split_shares, generator=generator
    )
    tiles = _sort_into_splits(cut, splits)
    if placed is not None:
        _write_datasets(folder, tiles, cut.annotations, settings.gsd_m)
    sensor = _sensor(folder, tiles, settings.gsd_m, notes)
    tiles = lit_tiles(folder, tiles, settings.gsd_m, suns, _middles(cut.annotations), notes)
    record = TilingRecord(
        settings=_settings_record(settings, source_settings),
        sources=[_describe(source) for source in sources],
        blocks_m=blocks_m,
        counts=_counts(tiles, cut.annotations),
        empty=len(cut.cells) - len(tiles),
        notes=notes,
    )
    write_ground_index(folder, tiles, cut.kept)
    write_json(folder / "tiling.json", dataclasses.asdict(record))
    # The index comes last: a folder with one is whole.
    write_index(folder, settings.gsd_m, tiles, sensor)
    return record


def _cut_cell(cut: _Cut, cell: Cell, placed: PlacedLabels | None, reader: SourceReader) -> None:
    """Writes a cell that sources fill as a tile, with its map of drivable ground."""
    image = read_cell(cell, cut.sources, reader)
    if image is None:
        return
    vehicles = None
    if placed is not None:
        rows = cut.annotations[cell.id] = placed.on(cell, image.owner)
        boxes = [row.box_xyxy for row in rows if not row.ignore]
        vehicles = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    tile = _tile(cell, image, cut.sources)
    pixels = torch.from_numpy(image.pixels)
    save_tile(cut.folder, tile, pixels)
    directions = drivable_directions(pixels, cell.gsd_m, vehicles)
    drivable = save_map(cut.folder, "drivable", tile.id, directions)
    cut.tiles.append(dataclasses.replace(tile, drivable=drivable))
    cut.kept[cell.id] = cell


def _refuse_too_few(count: int, settings: TilingSettings) -> None:
    if not count:
        raise ImageryError(
            f"No tile of {settings.size_px} px at {settings.gsd_m} m per pixel holds data: more "
            "than 2 % of each is empty (nodata or beyond the border); give larger images or a "
            "smaller size."
        )
    splits = len(settings.split_shares)
    if settings.minimum_px is not None and count < splits:
        raise ImageryError(
            f"The imagery yields {count} tiles of at least {settings.minimum_px} px at "
            f"{settings.gsd_m} m per pixel but the {splits} splits need {splits}; give more or "
            "larger images."
        )


def _settings_record(settings: TilingSettings, source: SourceSettings) -> dict[str, Any]:
    of_source = dataclasses.asdict(source)
    named = dataclasses.asdict(settings) | {"source_gsd_m": of_source.pop("gsd_m")} | of_source
    return json.loads(json.dumps(named, default=str))


def _middles(annotations: Mapping[str, Sequence[Annotation]]) -> dict[str, torch.Tensor]:
    """Returns the middles of each tile's labelled objects, `[n, 2]`."""
    return {
        name: torch.tensor([row.centre_px for row in rows], dtype=torch.float32).reshape(-1, 2)
        for name, rows in annotations.items()
    }


def _sensor(
    folder: Path, tiles: Sequence[BackgroundTile], gsd_m: float, notes: list[str]
) -> Sensor:
    """Measures blur and noise of some of the tiles; with too few edges the default is taken."""
    try:
        backgrounds = BackgroundSet(folder, gsd_m, tiles)
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


def _tile(cell: Cell, image: CellImage, sources: Sequence[Source]) -> BackgroundTile:
    shown = [sources[number] for number in np.unique(image.owner[image.owner >= 0])]
    _, row, column = cell.block
    licences = dict.fromkeys(source.licence for source in shown if source.licence)
    return BackgroundTile(
        id=cell.id,
        file=f"{_WAITING}/{cell.id}.png",
        # The real split is known when all cells have been read.
        split=SPLITS[0],
        width_px=cell.size_px,
        height_px=cell.size_px,
        source=" + ".join(_names(cell, shown)),
        offset_px=(column * cell.size_px, row * cell.size_px),
        licence="; ".join(licences) or None,
    )


def _names(cell: Cell, shown: Sequence[Source]) -> list[str]:
    """Names the images of a tile, or the folders of several small ones."""
    small = len(shown) > 1 and all(source.smaller_side_m < cell.side_m for source in shown)
    names = (source.path.resolve().parent.name if small else source.path.name for source in shown)
    return list(dict.fromkeys(names))


def _notes(sources: Sequence[Source]) -> list[str]:
    """Names the image before each of its notes, or their number if many have the same note."""
    of_note: dict[str, list[str]] = {}
    for source in sources:
        for note in source.notes:
            of_note.setdefault(note, []).append(source.path.name)
    return [
        f"{name}: {note}"
        for note, names in of_note.items()
        for name in (names if len(names) <= _SAME_NOTES else [f"{len(names):,} images"])
    ]


def _sort_into_splits(cut: _Cut, splits: Mapping[str, Split]) -> list[BackgroundTile]:
    """Moves the pictures into the folders of their splits, and notes empty splits."""
    for split in SPLITS:
        (cut.folder / split / "images").mkdir(parents=True, exist_ok=True)
    moved = []
    for tile in cut.tiles:
        file = f"{splits[tile.id]}/images/{tile.id}.png"
        (cut.folder / tile.file).rename(cut.folder / file)
        moved.append(dataclasses.replace(tile, file=file, split=splits[tile.id]))
    (cut.folder / _WAITING).rmdir()
    cut.notes += [
        f"{split} is empty: there are not enough tiles; give more imagery or a smaller size"
        for split in cut.settings.split_shares
        if split not in splits.values()
    ]
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
            for tile in tiles:
                if tile.split == split:
                    size_px = (tile.width_px, tile.height_px)
                    writer.add_written(tile.id, size_px, annotations[tile.id])


def _counts(
    tiles: Sequence[BackgroundTile], annotations: Mapping[str, Sequence[Annotation]]
) -> dict[str, dict[str, int]]:
    counts: dict[str, dict[str, int]] = {
        split: {"tiles": 0, "vehicles": 0, "ignored": 0} for split in SPLITS
    }
    for tile in tiles:
        counts[tile.split]["tiles"] += 1
        for row in annotations.get(tile.id, ()):
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
