"""Removes vehicles from a tiled folder; a tile that cannot be cleared is left out (section 5.2)."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.datasets.coco import ANNOTATIONS, drop_images
from skyproof.datasets.dataset import boxes_of
from skyproof.datasets.pictures import Boxes, Pixels
from skyproof.detectors.detector import TrainableDetector
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, ImageryError, StoredFileError
from skyproof.files import refuse_links, write_json
from skyproof.imagery.clearing.exemplar import fill_ground
from skyproof.imagery.clearing.footprints import sunlit
from skyproof.imagery.clearing.labelled import (
    TileLabels,
    detected_vehicles,
    labelled_vehicles,
    read_labels_of_tiles,
)
from skyproof.imagery.clearing.sheet import SheetRow, write_figure, write_page
from skyproof.imagery.clearing.sunlight import lights_record, measured_lights
from skyproof.imagery.clearing.vehicle_masks import (
    Shadow,
    VehicleFinder,
    check_resolution,
    darkness_profiles,
    estimate_shadow,
    grown_to_what_is_seen,
    other_vehicles,
    vehicle_mask,
)
from skyproof.imagery.drivable import drivable_directions
from skyproof.imagery.photographs import picture_of
from skyproof.imagery.tiles.tiling import copy_ground_index
from skyproof.layout import CLEARING_RECORD
from skyproof.render.dataset import in_threads
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.splits import SPLITS

_Result = TypeVar("_Result")
Fill = Callable[[Pixels, Bool[Tensor, "H W"]], Pixels]

MARGIN_M = 0.4
"""Growth of boxes on all sides; doubled if the shadow is unknown."""
LARGEST_MASKED_SHARE = 0.35
"""A tile with more to remove is left out."""
ROUNDS = 2
"""Repairs of a tile in which the detector still finds a vehicle."""

_REMEDY = "copy the whole folder again, or clear the imagery again"


@dataclass
class Cleared:
    """The row of one tile in the record.

    `labelled` also counts ignore regions, `detected` also the vehicles that repairs removed, and
    `remaining` those that the checker still found (None without a checker).
    """

    id: str
    split: str
    labelled: int
    detected: int
    places: int = 0
    masked_share: float = 0.0
    rounds: int = 0
    remaining: int | None = None
    left_out: str | None = None


@dataclass(frozen=True)
class _Found:
    """The boxes to remove from a tile (`labelled` and `detected`), and the vehicles on it.

    `vehicles` are the boxes of labelled vehicles, None where nobody labelled, and `places` are
    where they stood. `seen` adds the detections, which may not be vehicles: they help to
    measure shadows, and never become places.
    """

    labelled: Boxes
    detected: Boxes
    vehicles: Boxes | None
    places: list[RemovedVehicle]
    seen: list[RemovedVehicle]
    profiles: Float[Tensor, "k directions layers"]


@dataclass(frozen=True)
class _Clearing:
    backgrounds: BackgroundSet
    out: Path
    labels: Mapping[str, TileLabels] | None
    fill: Fill
    finder: VehicleFinder | None
    checker: VehicleFinder | None


def clear_backgrounds(
    folder: Path,
    out: Path,
    *,
    fill: Fill = fill_ground,
    finder: VehicleFinder | None = None,
    checker: VehicleFinder | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> dict[str, Any]:
    """Writes a tiled folder of the same tiles without their vehicles, and returns its record.

    Labelled vehicles, ignored objects, and the detections of `finder` are removed. Without a
    finder, unlabelled regions are filled as a whole. Tiles on which `checker` still finds a vehicle
    are repaired, and left out if that does not help. Every tile keeps the places of its labelled
    vehicles, a new map of drivable ground, and the light by the shadows of vehicles. A contact
    sheet shows the changes. Use `finished_folder` around `out`. `fill` fills a mask of a tile and
    leaves every byte outside it. `progress` gets ("find" or "clear", tiles done, tiles in all).

    Raises:
        ConfigurationError: there are neither labels nor a finder, or a detector has another
            resolution.
        ImageryError: no tile is left.
        StoredFileError: the folder is not a tiled folder.
    """
    backgrounds = BackgroundSet.open(folder)
    tiles = backgrounds.all_tiles()
    labels = read_labels_of_tiles(folder)
    if labels is None and finder is None:
        raise ConfigurationError(
            f"{folder} holds no labels (<split>/annotations.json) and no detector was given, so no "
            "vehicle can be found; give --detector, or tile the imagery with its labels."
        )
    for used in (finder, checker):
        check_resolution(used, backgrounds.gsd_m)
    clearing = _Clearing(backgrounds, out, labels, fill, finder, checker)
    # Vehicles of all tiles come first: a shadow is estimated from all tiles of one picture.
    found: dict[str, _Found] = {}
    profiles: dict[str, list[Tensor]] = defaultdict(list)
    with _by_tile(clearing, partial(_find, clearing), tiles) as every:
        for done, (tile, one) in enumerate(zip(tiles, every, strict=True), start=1):
            found[tile.id] = one
            profiles[picture_of(tile)].append(one.profiles)
            progress("find", done, len(tiles))
    shadows = {picture: estimate_shadow(measured) for picture, measured in profiles.items()}
    lights = measured_lights(backgrounds, tiles, {name: one.seen for name, one in found.items()})

    def clear(tile: BackgroundTile) -> tuple[Cleared, SheetRow | None, BackgroundTile | None]:
        picture, one = picture_of(tile), found[tile.id]
        row, shown, image = _clear_tile(clearing, tile, one, shadows[picture])
        if row.left_out is not None:
            return row, shown, None
        lit = replace(tile, light=lights.get(picture, tile.light))
        return row, shown, _stored(clearing, lit, image, one)

    rows, kept = [], []
    figures: list[str] = []
    with _by_tile(clearing, clear, tiles) as cleared:
        for done, (row, shown, stored) in enumerate(cleared, start=1):
            rows.append(row)
            if shown is not None:
                figures.append(write_figure(out / "sheets", len(figures) + 1, shown))
            if stored is not None:
                kept.append(stored)
            progress("clear", done, len(tiles))
    write_page(out / "sheets", figures)
    record = _record(clearing, rows, shadows) | lights_record(lights)
    if not kept:
        reasons = ", ".join(f"{count} {why}" for why, count in record["totals"]["left_out"].items())
        raise ImageryError(
            f"No tile of {folder} could be cleared ({reasons}); give a better detector."
        )
    write_json(out / CLEARING_RECORD, record)
    copy_ground_index(folder, out, {tile.id for tile in kept})
    write_index(out, backgrounds.gsd_m, kept, backgrounds.sensor, backgrounds.light)
    return record


def _by_tile(
    clearing: _Clearing, work: Callable[[BackgroundTile], _Result], tiles: Sequence[BackgroundTile]
) -> AbstractContextManager[Iterator[_Result]]:
    """Yields the results of `work` in order, from several threads unless there are black boxes."""
    used = [each.detector for each in (clearing.finder, clearing.checker) if each is not None]
    if not all(isinstance(each, TrainableDetector) for each in used):
        return nullcontext(map(work, tiles))
    return in_threads(work, tiles, torch.get_num_threads())


def _find(clearing: _Clearing, tile: BackgroundTile) -> _Found:
    labels = (clearing.labels or {}).get(tile.id, TileLabels())
    gsd_m, finder = clearing.backgrounds.gsd_m, clearing.finder
    image = clearing.backgrounds.pixels(tile.id)
    labelled = boxes_of([*labels.vehicles, *labels.ignored])
    detected = torch.zeros(0, 4)
    if finder is None:
        # Without a detector, unlabelled regions may hold vehicles: they are filled whole.
        labelled = torch.cat([labelled, boxes_of(labels.unlabelled)])
    else:
        seen = finder.detections(image)
        detected = other_vehicles(seen, labelled)
        labelled = grown_to_what_is_seen(labelled, seen)
    # Where nobody labelled, the absence of labels does not mean that no vehicle may stand there.
    told = clearing.labels is not None and (labels.vehicles or not labels.unlabelled)
    places = labelled_vehicles(image, labels, gsd_m)
    return _Found(
        labelled,
        detected,
        boxes_of(labels.vehicles) if told else None,
        places,
        places + detected_vehicles(image, detected, gsd_m),
        darkness_profiles(image, torch.cat([labelled, detected]), gsd_m=gsd_m),
    )


def _clear_tile(
    clearing: _Clearing, tile: BackgroundTile, found: _Found, shadow: Shadow | None
) -> tuple[Cleared, SheetRow | None, Pixels]:
    """Fills one tile and checks it; returns its picture for the sheet if it changed."""
    checker, gsd_m = clearing.checker, clearing.backgrounds.gsd_m
    row = Cleared(tile.id, tile.split, len(found.labelled), len(found.detected), len(found.places))
    before = image = clearing.backgrounds.pixels(tile.id)
    mask = torch.zeros(image.shape[1:], dtype=torch.bool)
    boxes, remaining = torch.cat([found.labelled, found.detected]), torch.zeros(0, 4)
    while True:
        round_mask = vehicle_mask(mask.shape, boxes, shadow, gsd_m=gsd_m, margin_m=MARGIN_M)
        mask |= round_mask
        row.masked_share = round(float(mask.float().mean()), 4)
        if row.masked_share > LARGEST_MASKED_SHARE:
            row.left_out = "too much to remove"
            break
        if round_mask.any():
            image = clearing.fill(image, round_mask)
        if checker is None:
            break
        remaining = checker.detections(image)
        row.remaining = len(remaining)
        if not len(remaining):
            break
        if row.rounds == ROUNDS:
            row.left_out = "a vehicle is still found"
            break
        row.rounds += 1
        row.detected += len(remaining)
        boxes = remaining
    kept = row.left_out is None
    shown = None
    if mask.any() or not kept:
        shown = SheetRow(tile.id, _caption(row), kept, before, image, mask, remaining)
    return row, shown, image


def _stored(
    clearing: _Clearing, tile: BackgroundTile, image: Pixels, found: _Found
) -> BackgroundTile:
    """Writes a cleared tile, with the places of its vehicles and a new map of drivable ground."""
    backgrounds, out = clearing.backgrounds, clearing.out
    save_tile(out, tile, image)
    shade = backgrounds.map_of(tile.id, "shade")
    cover = backgrounds.map_of(tile.id, "cover")
    directions = drivable_directions(image, backgrounds.gsd_m, found.vehicles, found.places)
    return replace(
        tile,
        removed=(*tile.removed, *sunlit(image, found.places, backgrounds.gsd_m)),
        drivable=save_map(out, "drivable", tile.id, directions),
        shade=None if shade is None else save_map(out, "shade", tile.id, shade.numpy()),
        cover=None if cover is None else save_map(out, "cover", tile.id, cover.numpy()),
    )


def _caption(row: Cleared) -> str:
    state = f"LEFT OUT: {row.left_out}" if row.left_out else "kept"
    check = "not checked by a detector" if row.remaining is None else f"check finds {row.remaining}"
    vehicles = f"{row.labelled} labelled + {row.detected} detected removed"
    share = f"{row.masked_share:.1%} masked"
    return f"{row.split}, {vehicles}, {share}, {row.rounds} repairs, {check}, {state}"


def _record(
    clearing: _Clearing, rows: Sequence[Cleared], shadows: Mapping[str, Shadow | None]
) -> dict[str, Any]:
    finder, checker = clearing.finder, clearing.checker
    kept = [row for row in rows if row.left_out is None]
    vehicles_from = [] if clearing.labels is None else ["labels"]
    if finder is not None:
        vehicles_from.append(finder.name)
    checked_by: Any = "not checked by a detector"
    if checker is not None:
        checked_by = {"name": checker.name, "threshold": checker.detector.threshold}
    return {
        "format_version": 1,
        "settings": {
            "finding_score": None,
            "margin_m": MARGIN_M,
            "largest_masked_share": LARGEST_MASKED_SHARE,
            "rounds": ROUNDS,
        },
        "vehicles_from": vehicles_from,
        "checked_by": checked_by,
        "shadows": {
            picture: shadow and {**asdict(shadow), "direction": list(shadow.direction)}
            for picture, shadow in shadows.items()
        },
        "totals": {
            "tiles": len(rows),
            "kept": len(kept),
            "left_out": dict(Counter(row.left_out for row in rows if row.left_out)),
            "splits_without_tiles": splits_left_empty(rows, kept),
            "labelled_removed": sum(row.labelled for row in kept),
            "places": sum(row.places for row in kept),
            "detected_removed": sum(row.detected for row in kept),
            "masked_share": round(sum(row.masked_share for row in kept) / max(len(kept), 1), 4),
        },
        "tiles": [asdict(row) for row in rows],
    }


def reject_tiles(folder: Path, ids: Sequence[str]) -> list[str]:
    """Removes tiles from index and annotations, and returns the splits that this empties.

    An id that is not in the index, or rejecting every tile, raises ConfigurationError.
    """
    refuse_links(folder)
    backgrounds = BackgroundSet.open(folder)
    tiles = backgrounds.all_tiles()
    unknown = sorted(set(ids) - {tile.id for tile in tiles})
    if unknown:
        raise ConfigurationError(f"{folder} has no tile {unknown[0]!r}; the ids are on the sheets.")
    kept = [tile for tile in tiles if tile.id not in set(ids)]
    if not kept:
        raise ConfigurationError(
            f"Every tile of {folder} would be rejected; clear the imagery again instead."
        )
    path = folder / CLEARING_RECORD
    if path.is_file():
        record: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
        before = record.get("rejected", [])
        if not isinstance(before, list) or not all(isinstance(name, str) for name in before):
            raise StoredFileError(f"{path}, rejected: expected a list of tiles; {_REMEDY}.")
        write_json(path, {**record, "rejected": sorted({*before, *ids})})
    for split in SPLITS:
        if (folder / split / ANNOTATIONS).is_file():
            drop_images(folder / split, ids)
    copy_ground_index(folder, folder, {tile.id for tile in kept})
    write_index(folder, backgrounds.gsd_m, kept, backgrounds.sensor, backgrounds.light)
    return splits_left_empty(tiles, kept)


def splits_left_empty(before: Iterable[Any], after: Iterable[Any]) -> list[str]:
    """Lists the splits that have tiles, or rows of tiles, before but not after."""
    gone = {tile.split for tile in before} - {tile.split for tile in after}
    return [split for split in SPLITS if split in gone]
