"""Which photographed vehicles can be fitted, and why others cannot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from skyproof.errors import ConfigurationError
from skyproof.generator.photographed import photographed_vehicles, shown_pixels
from skyproof.render.renderer import photographs as pictures
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.places import RemovedVehicle
from tests.generator.photographs import Photographs


def changed(sets: BackgroundSet, **changes: object) -> BackgroundSet:
    """The same set, its tiles changed."""
    tiles = [replace(tile, **changes) for tile in sets.all_tiles()]
    return BackgroundSet(sets.folder, sets.gsd_m, tiles, sets.sensor, sets.light)


def first(sets: BackgroundSet) -> tuple[BackgroundTile, RemovedVehicle]:
    tile = sets.all_tiles()[0]
    return tile, tile.removed[0]


def test_vehicles_lie_in_their_windows(photographs: Photographs) -> None:
    vehicles, left_out = photographed_vehicles(photographs.tiles, photographs.cleared)
    assert (len(vehicles), left_out) == (9, {})
    scenes = [vehicle.scene for vehicle in vehicles]
    device = torch.device("cpu")
    with_them = pictures(photographs.tiles, scenes, device)
    without = pictures(photographs.cleared, scenes, device)
    for vehicle, taken, empty in zip(vehicles, with_them, without, strict=True):
        moved = (taken - empty).abs().amax(0) > 0.02
        # What changed is the vehicle; a window that was turned or mirrored would show ground.
        assert float(moved[shown_pixels(vehicle, -0.2)].float().mean()) > 0.9
        assert not bool((shown_pixels(vehicle) & ~shown_pixels(vehicle, 0.5)).any())


def test_nobody_takes_another_vehicles_pixels(photographs: Photographs) -> None:
    vehicles, _ = photographed_vehicles(photographs.tiles, photographs.cleared)
    vehicle = vehicles[0]
    placement = vehicle.scene.placements[0]
    beside = (placement.x_m, placement.y_m, placement.heading_rad, 1.0, 1.0)
    less = shown_pixels(replace(vehicle, others=(beside,)))
    assert 0 < int(less.sum()) < int(shown_pixels(replace(vehicle, others=())).sum())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"heading_rad": None, "heading_from": None}, "its heading is not known"),
        ({"length_m": 2.4}, "it is shorter than 20 px"),
    ],
)
def test_one_that_cannot_be_fitted_is_left_out(
    photographs: Photographs, change: dict[str, object], reason: str
) -> None:
    tile, vehicle = first(photographs.cleared)
    removed = (replace(vehicle, **change), *tile.removed[1:])
    cleared = changed(photographs.cleared, removed=removed)
    vehicles, left_out = photographed_vehicles(photographs.tiles, cleared)
    assert (len(vehicles), left_out) == (8, {reason: 1})


@pytest.mark.parametrize(("value", "kept"), [(20, 9), (60, 8), (255, 8)])
def test_one_beneath_a_crown_is_left_out_however_much_it_hides(
    photographs: Photographs, monkeypatch: pytest.MonkeyPatch, value: int, kept: int
) -> None:
    tile, vehicle = first(photographs.cleared)
    cover = torch.zeros(tile.height_px, tile.width_px, dtype=torch.uint8)
    row, column = int(vehicle.y_px), int(vehicle.x_px)
    cover[max(0, row - 24) : row + 24, max(0, column - 24) : column + 24] = value
    stored = BackgroundSet.map_of
    monkeypatch.setattr(
        BackgroundSet,
        "map_of",
        lambda own, tile_id, kind: cover if kind == "cover" else stored(own, tile_id, kind),
    )
    vehicles, left_out = photographed_vehicles(photographs.tiles, photographs.cleared)
    assert len(vehicles) == kept
    assert left_out == ({} if kept == 9 else {"crowns or roofs cover it": 1})


def test_without_a_sun_nothing_can_be_fitted(photographs: Photographs) -> None:
    cleared = changed(photographs.cleared, light=Light())
    with pytest.raises(ConfigurationError, match="9 because the sun of its photograph"):
        photographed_vehicles(photographs.tiles, cleared)
    overcast = changed(photographs.cleared, light=Light(sky=(1.0, 1.0, 1.0)))
    assert len(photographed_vehicles(photographs.tiles, overcast)[0]) == 9


def test_folders_that_do_not_belong_together_are_refused(photographs: Photographs) -> None:
    tiles = photographs.tiles
    other = BackgroundSet(tiles.folder, 0.2, tiles.all_tiles())
    with pytest.raises(ConfigurationError, match="what skyproof clear made of them"):
        photographed_vehicles(other, photographs.cleared)
    renamed = [replace(tile, id=f"other-{tile.id}") for tile in tiles.all_tiles()]
    other = BackgroundSet(Path("elsewhere"), tiles.gsd_m, renamed)
    with pytest.raises(ConfigurationError, match="has no tile"):
        photographed_vehicles(other, photographs.cleared)
    with pytest.raises(ConfigurationError, match="says of no vehicle where it stood"):
        photographed_vehicles(tiles, changed(photographs.cleared, removed=()))
