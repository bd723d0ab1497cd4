"""Removes vehicles from a tiled folder: finds, masks with shadows, fills, checks, repairs.

A tile that cannot be cleared is left out (section 5.2).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.files import write_json
from skyproof.imagery.clearing.exemplar import fill_ground
from skyproof.imagery.clearing.labelled import TileLabels, read_labels_of_tiles, removed_vehicles
from skyproof.imagery.clearing.shaded import lights_record, shaded_tiles
from skyproof.imagery.clearing.sheet import ContactSheet, SheetRow
from skyproof.imagery.clearing.sunlight import measured_lights, picture_of
from skyproof.imagery.clearing.vehicle_finder import (
    VehicleFinder,
    check_resolution,
    grown_to_what_is_seen,
    other_vehicles,
)
from skyproof.imagery.clearing.vehicle_masks import (
    Shadow,
    darkness_profiles,
    estimate_shadow,
    vehicle_mask,
)
from skyproof.imagery.drivable import drivable_directions
from skyproof.imagery.settings import ClearSettings
from skyproof.imagery.tiles.tile_index import copy_ground_index
from skyproof.layout import CLEARING_RECORD
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.splits import SPLITS

Fill = Callable[[UInt8[Tensor, "3 H W"], Bool[Tensor, "H W"]], UInt8[Tensor, "3 H W"]]


@dataclass
class Cleared:
    """What became of one tile; one row of the record.

    Attributes:
        labelled: vehicles removed because of a label, ignore regions included.
        detected: vehicles removed because only the detector found them, repairs included.
        places: vehicles whose place is kept: those that are labelled or surely detected.
        masked_share: share of pixels that were filled, after the last round.
        rounds: repairs after the first filling.
        remaining: what the check found in the end; None without a check.
        left_out: why the tile is not in the result, or None.
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


@dataclass
class _Found:
    """What is removed from a tile; of these, `sure` boxes are vehicles beyond doubt."""

    labelled: Float[Tensor, "n 4"]
    detected: Float[Tensor, "m 4"]
    sure: Float[Tensor, "s 4"]
    removed: tuple[RemovedVehicle, ...]
    profiles: Float[Tensor, "k directions layers"] = field(
        default_factory=lambda: torch.zeros(0, 1, 1)
    )

    @property
    def boxes(self) -> Tensor:
        return torch.cat([self.labelled, self.detected])


def clear_backgrounds(
    folder: Path,
    out: Path,
    settings: ClearSettings | None = None,
    *,
    fill: Fill = fill_ground,
    finder: VehicleFinder | None = None,
    checker: VehicleFinder | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Writes a tiled folder of the same tiles without their vehicles.

    The places and headings of the vehicles are stored with every tile, and the map of drivable
    ground is made anew. Shadows of the vehicles, of trees and of buildings tell the sun and the sky
    of each source, which are stored as well.

    Removed are labelled vehicles, ignored objects, and the detections of `finder`. Without a
    finder, unlabelled regions are filled as a whole. Tiles on which `checker` still finds a vehicle
    are repaired, and left out if that does not help. A contact sheet shows every tile that was
    changed or left out.

    Args:
        folder: a tiled folder, with or without `<split>/annotations.json`.
        out: gets the tiles, their maps of drivable ground and of shadows, `index.json`,
            `index.geojson`, `clearing.json` and `sheets/`; use `finished_folder` around it.
        fill: fills a mask of a tile and leaves every byte outside it as it was.
        finder: finds vehicles that are not labelled.
        checker: looks at the result, at its own threshold.
        progress: called with ("find" or "clear", tiles done, tiles in all).

    Returns:
        The record, as written to `clearing.json`.

    Raises:
        ConfigurationError: neither labels nor a finder, or a detector of another resolution.
        ImageryError: no tile is left.
        StoredFileError: the folder is not a tiled folder.
    """
    settings = settings or ClearSettings()
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
    # Vehicles of all tiles first: a shadow is estimated from all tiles of one picture.
    found = {}
    for done, tile in enumerate(tiles, start=1):
        of_tile = (labels or {}).get(tile.id, TileLabels())
        found[tile.id] = _find(backgrounds, tile, of_tile, finder, settings)
        if progress is not None:
            progress("find", done, len(tiles))
    shadows = _shadows(tiles, found)
    lights = measured_lights(backgrounds, tiles, {name: own.removed for name, own in found.items()})
    # Each tile is filled, checked and written.
    rows, kept = [], []
    with ContactSheet(out / "sheets") as sheet:
        for done, tile in enumerate(tiles, start=1):
            row, sheet_row = _clear_tile(
                backgrounds,
                tile,
                found[tile.id],
                shadows[picture_of(tile)],
                fill,
                settings,
                checker,
                out,
            )
            rows.append(row)
            if row.left_out is None:
                lit = replace(tile, light=lights[tile.id])
                own = found[tile.id]
                kept.append(_with_places(out, lit, own, backgrounds, labelled=labels is not None))
            if sheet_row is not None:
                sheet.add(sheet_row)
            if progress is not None:
                progress("clear", done, len(tiles))
    record = _record(rows, shadows, settings, finder, checker, labels is not None)
    if not kept:
        reasons = ", ".join(f"{count} {why}" for why, count in record["totals"]["left_out"].items())
        raise ImageryError(
            f"No tile of {folder} could be cleared ({reasons}); give a better detector, or allow a "
            "larger ClearSettings.largest_masked_share."
        )
    kept = shaded_tiles(
        BackgroundSet(out, backgrounds.gsd_m, kept, backgrounds.sensor, backgrounds.light)
    )
    record |= lights_record(tiles, lights, kept)
    write_json(out / CLEARING_RECORD, record)
    copy_ground_index(folder, out, {tile.id for tile in kept})
    write_index(out, backgrounds.gsd_m, kept, backgrounds.sensor, backgrounds.light)
    return record


def _find(
    backgrounds: BackgroundSet,
    tile: BackgroundTile,
    labels: TileLabels,
    finder: VehicleFinder | None,
    settings: ClearSettings,
) -> _Found:
    labelled = labels.boxes
    image = backgrounds.pixels(tile.id)
    detected, sure = torch.zeros(0, 4), torch.zeros(0, 4)
    if finder is None:
        # Unlabelled regions may hold vehicles that no detector looks for: they are filled whole.
        labelled = torch.cat([labelled, labels.unlabelled_boxes])
    else:
        threshold = finder.detector.threshold
        lowest_score = threshold if settings.finding_score is None else settings.finding_score
        everything = finder.detections(image, lowest_score)
        detections = other_vehicles(everything, labelled)
        labelled = grown_to_what_is_seen(labelled, everything)
        detected = detections.boxes
        # Below the threshold, many detections that are removed to be safe are no vehicles.
        sure = detected[detections.scores >= threshold]
    removed = removed_vehicles(image, labels, sure, backgrounds.gsd_m)
    found = _Found(labelled, detected, torch.cat([labels.vehicle_boxes, sure]), removed)
    if len(found.boxes):
        found.profiles = darkness_profiles(image, found.boxes, gsd_m=backgrounds.gsd_m)
    return found


def _with_places(
    out: Path, tile: BackgroundTile, found: _Found, backgrounds: BackgroundSet, *, labelled: bool
) -> BackgroundTile:
    """Adds to a cleared tile where vehicles stood, and looks anew where they may stand."""
    gsd_m = backgrounds.gsd_m
    cleared = BackgroundSet(out, gsd_m, [tile]).pixels(tile.id)
    shade = backgrounds.shade(tile.id)
    cover = backgrounds.cover(tile.id)
    # On an unlabelled tile, the absence of finds does not mean that no vehicle may stand there.
    stood = found.sure if labelled or len(found.sure) else None
    directions = drivable_directions(cleared, gsd_m, stood, cover)
    return replace(
        tile,
        removed=(*tile.removed, *found.removed),
        drivable=save_map(out, "drivable", tile.id, directions),
        shade=None if shade is None else save_map(out, "shade", tile.id, shade.numpy()),
        cover=None if cover is None else save_map(out, "cover", tile.id, cover.numpy()),
    )


def _shadows(
    tiles: Sequence[BackgroundTile], found: Mapping[str, _Found]
) -> dict[str, Shadow | None]:
    profiles: dict[str, list[Tensor]] = defaultdict(list)
    for tile in tiles:
        profile = found[tile.id].profiles
        profiles[picture_of(tile)] += [profile] if len(profile) else []
    return {
        light: estimate_shadow(profiles_of_light)
        for light, profiles_of_light in ((picture_of(t), profiles[picture_of(t)]) for t in tiles)
    }


def _clear_tile(
    backgrounds: BackgroundSet,
    tile: BackgroundTile,
    found: _Found,
    shadow: Shadow | None,
    fill: Fill,
    settings: ClearSettings,
    checker: VehicleFinder | None,
    out: Path,
) -> tuple[Cleared, SheetRow | None]:
    """Fills one tile, checks it and stores it."""
    row = Cleared(tile.id, tile.split, len(found.labelled), len(found.detected), len(found.removed))
    before = backgrounds.pixels(tile.id)
    size = (tile.height_px, tile.width_px)
    image = before
    mask = torch.zeros(size, dtype=torch.bool)
    boxes = found.boxes
    remaining = torch.zeros(0, 4)
    while True:
        tile_mask = vehicle_mask(
            size, boxes, shadow, gsd_m=backgrounds.gsd_m, margin_m=settings.margin_m
        )
        mask |= tile_mask
        row.masked_share = round(float(mask.float().mean()), 4)
        if row.masked_share > settings.largest_masked_share:
            row.left_out = "too much to remove"
            break
        if tile_mask.any():
            image = fill(image, tile_mask)
        if checker is None:
            break
        remaining = checker.detections(image, checker.detector.threshold).boxes
        row.remaining = len(remaining)
        if not len(remaining):
            break
        if row.rounds == settings.rounds:
            row.left_out = "a vehicle is still found"
            break
        row.rounds += 1
        row.detected += len(remaining)
        boxes = remaining
    if row.left_out is None:
        save_tile(out, tile, image)
    if not mask.any() and row.left_out is None:
        return row, None
    kept = row.left_out is None
    return row, SheetRow(tile.id, _caption(row), kept, before, image, mask, remaining)


def _caption(row: Cleared) -> str:
    state = f"LEFT OUT: {row.left_out}" if row.left_out else "kept"
    check = "not checked by a detector" if row.remaining is None else f"check finds {row.remaining}"
    vehicles = f"{row.labelled} labelled + {row.detected} detected removed"
    share = f"{row.masked_share:.1%} masked"
    return f"{row.split}, {vehicles}, {share}, {row.rounds} repairs, {check}, {state}"


def _record(
    rows: Sequence[Cleared],
    shadows: Mapping[str, Shadow | None],
    settings: ClearSettings,
    finder: VehicleFinder | None,
    checker: VehicleFinder | None,
    labels: bool,
) -> dict[str, Any]:
    left_out = Counter(row.left_out for row in rows if row.left_out)
    kept = [row for row in rows if row.left_out is None]
    emptied = [
        s for s in SPLITS if any(r.split == s for r in rows) and all(r.split != s for r in kept)
    ]
    checked_by = (
        {"name": checker.name, "threshold": checker.detector.threshold}
        if checker
        else "not checked by a detector"
    )
    return {
        "format_version": 1,
        "settings": asdict(settings),
        "vehicles_from": [*(["labels"] if labels else []), *([finder.name] if finder else [])],
        "checked_by": checked_by,
        "shadows": {
            light: None
            if shadow is None
            else {**asdict(shadow), "direction": list(shadow.direction)}
            for light, shadow in shadows.items()
        },
        "totals": {
            "tiles": len(rows),
            "kept": len(kept),
            "left_out": dict(left_out),
            "splits_without_tiles": emptied,
            "labelled_removed": sum(row.labelled for row in kept),
            "places": sum(row.places for row in kept),
            "detected_removed": sum(row.detected for row in kept),
            "masked_share": round(sum(row.masked_share for row in kept) / max(len(kept), 1), 4),
        },
        "tiles": [asdict(row) for row in rows],
    }
