"""Cuts orthophotos into tiles: a background set, and datasets where there are labels."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.errors import ImageryError
from skyproof.files import write_json
from skyproof.imagery.drivable import drivable_directions
from skyproof.imagery.labels.label import Labels
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.imagery.sharpness import sensor_of_tiles
from skyproof.imagery.tiles.covers import cover_of, find_covers
from skyproof.imagery.tiles.grid import Cell, cells_of, lay_grids
from skyproof.imagery.tiles.lights import lit_tiles, sun_over
from skyproof.imagery.tiles.placed_labels import PlacedLabels
from skyproof.imagery.tiles.sources import (
    Source,
    SourceReader,
    find_images,
    gdal_limits,
    inspect_source,
)
from skyproof.imagery.tiles.splits import assign_splits
from skyproof.imagery.tiles.tile_index import cells_like, settings_like, write_ground_index
from skyproof.imagery.tiles.warp import CellImage, read_cell
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS, Split

_WAITING = "waiting"
_SAME_NOTES = 8


@dataclass(frozen=True)
class TilingRecord:
    """What was done: the content of `tiling.json`.

    Attributes:
        sources: per source its name, size, system, resolution, bands, range, nodata value and
            licence.
        blocks_m: per grid the width of its blocks.
        counts: per split its tiles, vehicles and ignore regions.
        empty: cells left out because more than 2 % of them is empty.
        missing: ids of tiles of `like` that the sources do not show.
        notes: what was assumed, repaired or left out.
    """

    settings: dict[str, Any]
    sources: list[dict[str, Any]]
    blocks_m: dict[str, float]
    counts: dict[str, dict[str, int]]
    empty: int
    missing: list[str]
    notes: list[str]


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

    It writes `index.json`, `index.geojson`, `<split>/images/*.png`, `drivable/*.png`, with masks
    `cover/*.png`, and `tiling.json`.

    Sources are read window by window: memory does not grow with them. The ground is cut into cells
    (`lay_grids`), a cell becomes a tile where sources show 98 % of it (`read_cell`), and blocks of
    cells go to the splits (`assign_splits`). Every place of georeferenced sources lies in one cell,
    so in one split, however many of them show it. Images without georeference that show the same
    ground, such as frames of a flight, cannot be told apart from others: splits may then share it.

    Blur and noise of the tiles are measured, so that vehicles are drawn as sharp as they are
    (`sensor_of_tiles`), and the exposure of each source, so that they are as bright
    (`measure_exposure`). Where vehicles may stand is told by a simple rule (`drivable_directions`).

    With labels every split also gets `annotations.json`, so that its folder is a dataset to train
    on. Tiles without any vehicle stay.

    Args:
        paths: images, or folders whose images (not those of their sub-folders) are taken.
        folder: where the set goes; use `finished_folder` around it so that a half-written one does
            not stay.
        settings: resolution, size, blocks; with `like` the first two are those of its set.
        labels: as read, and what counts as a vehicle.
        progress: called with (cells done, cells in all).

    Raises:
        ConfigurationError: settings that cannot work, or another resolution or size than `like`
            has.
        ImageryError: an image that is missing, unreadable, without resolution, or coarser than 50
            cm; images that hold no tile; labels that do not fit the imagery; a time at which the
            sun was down over them, or one for images without georeference.
        StoredFileError: `like` is not a tiled folder.
        RunFolderError: the disk cannot take it.
    """
    if settings.like is not None:
        settings = settings_like(settings, settings.like)
    files = find_images(paths)
    source_settings = source_settings or SourceSettings()
    kept: list[tuple[Cell, BackgroundTile]] = []
    annotations: dict[str, list[Annotation]] = {}
    # Every cell that sources fill becomes a tile, written while it is at hand.
    with gdal_limits(), SourceReader() as reader:
        sources = [inspect_source(path, source_settings, reader) for path in files]
        notes = _notes(sources)
        cells = _cells(sources, settings, notes)
        # A time that cannot be, or a mask that is missing, is refused before anything is cut.
        taken = source_settings.taken
        suns = {cell.id: sun_over(cell, taken) for cell in cells if taken and cell.sources}
        cover = source_settings.cover
        masks = [] if cover is None else find_covers(cover, sources, reader)
        placed = None if labels is None else PlacedLabels(labels[0], labels[1], sources, cells)
        notes += placed.notes if placed is not None else []
        for done, cell in enumerate(cells, 1):
            image = read_cell(cell, sources, reader) if cell.sources else None
            if image is not None:
                if placed is not None:
                    annotations[cell.id] = placed.on(cell, image.owner)
                hidden = cover_of(cell, image, masks, reader) if masks else None
                shown = [sources[number] for number in np.unique(image.owner[image.owner >= 0])]
                vehicles = _vehicles(annotations.get(cell.id))
                tile = _write_tile(folder, _tile(cell, shown), image, vehicles, hidden, settings)
                kept.append((cell, tile))
            if progress is not None:
                progress(done, len(cells))
    # Too little imagery is refused before anything else is written.
    _refuse_too_few(len(kept), settings)
    splits, blocks_m = _splits(kept, settings, generator)
    tiles = _sort_into_splits(folder, [tile for _, tile in kept], splits)
    for split in settings.split_shares:
        if split not in splits.values():
            notes.append(
                f"{split} is empty: there are not enough tiles; give more imagery or a smaller size"
            )
    if placed is not None:
        _write_datasets(folder, tiles, annotations, settings.gsd_m)
    sensor = _sensor(folder, tiles, settings.gsd_m, notes)
    tiles = lit_tiles(folder, tiles, settings.gsd_m, suns, _middles(annotations), notes)
    record = TilingRecord(
        settings=_settings_record(settings, source_settings),
        sources=[_describe(source) for source in sources],
        blocks_m=blocks_m,
        counts=_counts(tiles, annotations),
        empty=len(cells) - len(kept),
        missing=[cell.id for cell in cells if settings.like and cell.id not in splits],
        notes=notes,
    )
    write_ground_index(folder, tiles, {cell.id: cell for cell, _ in kept})
    write_json(folder / "tiling.json", dataclasses.asdict(record))
    # The index comes last: a folder with one is whole.
    write_index(folder, settings.gsd_m, tiles, sensor)
    return record


def _write_tile(
    folder: Path,
    tile: BackgroundTile,
    image: CellImage,
    vehicles: torch.Tensor | None,
    hidden: UInt8[np.ndarray, "S S"] | None,
    settings: TilingSettings,
) -> BackgroundTile:
    """Writes a tile's picture and its maps of drivable and of hidden ground."""
    pixels = torch.from_numpy(image.pixels)
    save_tile(folder, tile, pixels)
    cover = None if hidden is None else torch.from_numpy(hidden)
    directions = drivable_directions(pixels, settings.gsd_m, vehicles, cover)
    return dataclasses.replace(
        tile,
        drivable=save_map(folder, "drivable", tile.id, directions),
        cover=None if hidden is None else save_map(folder, "cover", tile.id, hidden),
    )


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
    named = dataclasses.asdict(settings) | {
        "source_gsd_m": source.gsd_m,
        "crs": source.crs,
        "licence": source.licence,
        "taken": source.taken,
        "cover": source.cover,
    }
    return json.loads(json.dumps(named, default=str))


def _middles(annotations: Mapping[str, Sequence[Annotation]]) -> dict[str, torch.Tensor]:
    """Gives the middles of each tile's labelled objects, `[n, 2]`."""
    return {
        name: torch.tensor([row.centre_px for row in rows], dtype=torch.float32).reshape(-1, 2)
        for name, rows in annotations.items()
    }


def _vehicles(annotations: Sequence[Annotation] | None) -> torch.Tensor | None:
    """Gives the boxes of a tile's labelled vehicles, `[n, 4]`; None where nobody labelled."""
    if annotations is None:
        return None
    boxes = [row.box_xyxy for row in annotations if not row.ignore]
    return torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)


def _sensor(
    folder: Path, tiles: Sequence[BackgroundTile], gsd_m: float, notes: list[str]
) -> Sensor:
    """Measures how sharp and noisy some of the tiles are.

    Where they show too few edges to tell, the usual sensor is taken.
    """
    backgrounds = BackgroundSet(folder, gsd_m, tiles)
    try:
        sensor = sensor_of_tiles(backgrounds, tiles)
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


def _cells(sources: Sequence[Source], settings: TilingSettings, notes: list[str]) -> list[Cell]:
    if settings.like is not None:
        return cells_like(settings.like, sources, notes)
    grids = lay_grids(
        sources,
        size_px=settings.size_px,
        minimum_px=settings.minimum_px or settings.size_px,
        wanted=len(settings.split_shares),
        gsd_m=settings.gsd_m,
        notes=notes,
    )
    return [cell for grid in grids for cell in cells_of(grid)]


def _tile(cell: Cell, shown: Sequence[Source]) -> BackgroundTile:
    licences = list(dict.fromkeys(source.licence for source in shown if source.licence))
    return BackgroundTile(
        id=cell.id,
        file=f"{_WAITING}/{cell.id}.png",
        # Which one it really is shows when all cells have been read.
        split=SPLITS[0],
        width_px=cell.size_px,
        height_px=cell.size_px,
        source=" + ".join(_names(cell, shown)),
        offset_px=cell.offset_px,
        licence="; ".join(licences) or None,
    )


def _names(cell: Cell, shown: Sequence[Source]) -> list[str]:
    """Names what a tile shows: its images, or of map tiles and others so small their folder."""
    side_m = cell.size_px * cell.gsd_m
    small = all(
        min(source.width_px * gsd[0], source.height_px * gsd[1]) < side_m
        for source in shown
        for gsd in [source.georeference.gsd_m]
    )
    folders = small and len(shown) > 1
    return list(
        dict.fromkeys(
            source.collection if folders or source.is_map_tile else source.path.name
            for source in shown
        )
    )


def _notes(sources: Sequence[Source]) -> list[str]:
    """Says what was assumed of each source, once where it is the same for many."""
    of_note: dict[str, list[str]] = {}
    for source in sources:
        for note in source.notes:
            of_note.setdefault(note, []).append(source.path.name)
    return [
        f"{name}: {note}"
        for note, names in of_note.items()
        for name in (names if len(names) <= _SAME_NOTES else [f"{len(names):,} images"])
    ]


def _splits(
    kept: Sequence[tuple[Cell, BackgroundTile]],
    settings: TilingSettings,
    generator: torch.Generator,
) -> tuple[dict[str, Split], dict[str, float]]:
    cells = [cell for cell, _ in kept]
    if settings.like is not None:
        return {cell.id: cell.split for cell in cells if cell.split is not None}, {}
    return assign_splits(
        cells, settings.split_shares, block_m=settings.block_m, generator=generator
    )


def _sort_into_splits(
    folder: Path, tiles: Sequence[BackgroundTile], splits: dict[str, Split]
) -> list[BackgroundTile]:
    """Moves the pictures, whose splits are known only when all cells have been read."""
    for split in SPLITS:
        (folder / split / "images").mkdir(parents=True, exist_ok=True)
    moved = []
    for tile in tiles:
        split = splits[tile.id]
        file = f"{split}/images/{tile.id}.png"
        (folder / tile.file).rename(folder / file)
        moved.append(dataclasses.replace(tile, file=file, split=split))
    (folder / _WAITING).rmdir()
    return moved


def _write_datasets(
    folder: Path,
    tiles: Sequence[BackgroundTile],
    annotations: dict[str, list[Annotation]],
    gsd_m: float,
) -> None:
    with ExitStack() as stack:
        source = {"description": "skyproof tiles"}
        writers = {
            split: stack.enter_context(CocoWriter(folder / split, gsd_m=gsd_m, source=source))
            for split in SPLITS
        }
        for tile in tiles:
            writers[tile.split].add_written(
                tile.id, (tile.width_px, tile.height_px), annotations[tile.id]
            )


def _counts(
    tiles: Sequence[BackgroundTile], annotations: dict[str, list[Annotation]]
) -> dict[str, dict[str, int]]:
    counts: dict[str, dict[str, int]] = {
        split: {"tiles": 0, "vehicles": 0, "ignored": 0} for split in SPLITS
    }
    for tile in tiles:
        rows = annotations.get(tile.id, [])
        counts[tile.split]["tiles"] += 1
        counts[tile.split]["vehicles"] += sum(not annotation.ignore for annotation in rows)
        counts[tile.split]["ignored"] += sum(annotation.ignore for annotation in rows)
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
