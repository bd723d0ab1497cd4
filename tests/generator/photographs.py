"""Photographs that tests make: drawn ground, and vehicles whose truth is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.background_index import save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import SunEstimate
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

TILE_PX = 256
SUN = SunEstimate(math.radians(40), math.radians(50))
SPACING_M = 8.0


@dataclass(frozen=True)
class Photographs:
    """Tiles with vehicles, the same without them, and what stands there.

    Attributes:
        tiles, cleared: background sets.
        fleet: the vehicles.
        stood: by "<tile>-<number>", as fits are called: the vehicle's id and true heading.
    """

    tiles: BackgroundSet
    cleared: BackgroundSet
    fleet: Fleet
    stood: dict[str, tuple[str, float]]


@torch.no_grad()
def take_photographs(folder: Path, count: int) -> Photographs:
    """Draws so many vehicles on ground, nine a tile, and writes both background sets.

    Places and headings are told as imprecisely as labels tell them, and headings modulo a half
    turn.
    """
    number = -(-count // 9)
    split = {"train": number, "validation": 0, "attack": 0, "test": 0}
    ground = write_procedural_backgrounds(folder / "ground", split, TILE_PX, seed=1)
    generator = torch.Generator().manual_seed(4)
    fleet = sample_fleet(FleetSettings(count, first_number=500), generator=generator)
    renderer = TorchRenderer(ground)
    stood: dict[str, tuple[str, float]] = {}
    taken, emptied = [], []
    left = list(fleet.ids)
    for tile in ground.all_tiles():
        ids, left = left[:9], left[9:]
        turns = torch.rand(len(ids), generator=generator).tolist()
        placements = tuple(
            Placement(
                vehicle,
                SPACING_M * (place % 3 - 1),
                SPACING_M * (place // 3 - 1),
                2 * math.pi * turn,
            )
            for place, (vehicle, turn) in enumerate(zip(ids, turns, strict=True))
        )
        scene = Scene(
            tile.id,
            BackgroundWindow(tile.id, TILE_PX / 2, TILE_PX / 2, 0.0),
            Camera(0.0, 0.0, ground.gsd_m, TILE_PX),
            SUN.sun,
            placements,
            seed=0,
        )
        image = renderer([scene], placed_vehicles(fleet, [scene])).image[0]
        save_tile(folder / "tiles", tile, (image * 255).round().byte())
        save_tile(folder / "cleared", tile, ground.pixels(tile.id))
        plain = replace(tile, drivable=None, shade=None, cover=None)
        taken.append(plain)
        removed = tuple(
            _told(placement, fleet.sizes_m[placement.vehicle], ground.gsd_m, generator)
            for placement in placements
        )
        light = replace(tile.light or ground.light, sun=SUN)
        emptied.append(replace(plain, removed=removed, light=light))
        for index, placement in enumerate(placements):
            stood[f"{tile.id}-{index:03d}"] = (placement.vehicle, placement.heading_rad)
    for name, tiles in (("tiles", taken), ("cleared", emptied)):
        write_index(folder / name, ground.gsd_m, tiles, ground.sensor, ground.light)
    return Photographs(
        BackgroundSet.open(folder / "tiles"),
        BackgroundSet.open(folder / "cleared"),
        fleet,
        stood,
    )


def _told(
    placement: Placement,
    size_m: tuple[float, float, float],
    gsd_m: float,
    generator: torch.Generator,
) -> RemovedVehicle:
    """What is known of a vehicle: its place to 10 cm, heading to 2 degrees, sides to 10 cm."""
    x, y, turn, length, width = torch.randn(5, generator=generator).tolist()
    return RemovedVehicle(
        x_px=TILE_PX / 2 + (placement.x_m + 0.1 * x) / gsd_m,
        y_px=TILE_PX / 2 - (placement.y_m + 0.1 * y) / gsd_m,
        heading_rad=(placement.heading_rad + math.radians(2) * turn) % math.pi,
        heading_from="picture",
        length_m=size_m[0] + 0.1 * length,
        width_m=size_m[1] + 0.1 * width,
    )
