"""Photographed vehicles that can be fitted: how each stood, and which pixels show it."""

import math
from collections import Counter
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.places import HeadingFrom, RemovedVehicle
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun
from skyproof.scenes.standing import standing

LEAST_PX = 20.0
"""A shorter vehicle shows too little of its panes to tell nose from tail."""

_WINDOW_M = 9.0
_LARGEST_COVERED = 0.1
_MARGIN_M = 0.4
_TOGETHER = "give the tiles, and what skyproof clear made of them"
_OVERCAST_FROM = 0.99
# Under an overcast sky the sun's place does not matter.
_ANY_SUN = Sun(0.0, math.pi / 3)


Rectangle = tuple[float, float, float, float, float]
"""The middle of a vehicle to the east and north, its heading, length and width."""


@dataclass(frozen=True)
class Photographed:
    """One vehicle of a photograph, and the scene in which it is drawn again.

    Attributes:
        scene: on the cleared tile, with one placement; of its two headings it has the first one.
        length_m, width_m: from the label, or guessed from its box.
        others: the middles of other vehicles nearby, with heading, length and width, in metres and
            radians of the scene; their pixels are not this vehicle's.
    """

    scene: Scene
    heading_from: HeadingFrom
    length_m: float
    width_m: float
    others: tuple[Rectangle, ...]


def photographed_vehicles(
    tiles: BackgroundSet, cleared: BackgroundSet
) -> tuple[list[Photographed], dict[str, int]]:
    """Finds the vehicles that can be fitted, and counts the others by why they cannot.

    The cleared tiles say where vehicles stood, and how the photographs show light.

    Raises:
        ConfigurationError: the two sets do not belong together, or no vehicle can be fitted; says
            why.
    """
    if cleared.gsd_m != tiles.gsd_m:
        raise ConfigurationError(
            f"{cleared.folder} has {cleared.gsd_m:g} m per pixel and {tiles.folder} "
            f"{tiles.gsd_m:g}; {_TOGETHER}."
        )
    size_px = 2 * math.ceil(_WINDOW_M / 2 / tiles.gsd_m)
    known = {tile.id for tile in tiles.all_tiles()}
    found: list[Photographed] = []
    left_out: Counter[str] = Counter()
    for tile in cleared.all_tiles():
        if tile.id not in known:
            raise ConfigurationError(
                f"{tiles.folder} has no tile {tile.id}, which {cleared.folder} has; {_TOGETHER}."
            )
        for number, vehicle in enumerate(tile.removed):
            fault = _fault(vehicle, tile, cleared, size_px)
            if fault is None:
                found.append(_photographed(number, tile, cleared, size_px))
            else:
                left_out[fault] += 1
    kept = [each for each in found if each.scene.placements[0].covered <= _LARGEST_COVERED]
    if len(kept) < len(found):
        left_out["crowns or roofs cover it"] = len(found) - len(kept)
    if not kept:
        raise ConfigurationError(_nothing(cleared, left_out))
    return kept, dict(left_out)


def shown_pixels(vehicle: Photographed, grown_m: float = _MARGIN_M) -> Bool[Tensor, "S S"]:
    """Returns which pixels of its window show a vehicle, and a margin of ground on every side."""
    placement = vehicle.scene.placements[0]
    camera = vehicle.scene.camera
    steps = (torch.arange(camera.size_px) + 0.5 - camera.size_px / 2) * camera.gsd_m
    north, east = torch.meshgrid(-steps, steps, indexing="ij")

    def within(rectangle: Rectangle, grown_m: float) -> Tensor:
        x_m, y_m, heading_rad, length_m, width_m = rectangle
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        along = cosine * (east - x_m) + sine * (north - y_m)
        across = cosine * (north - y_m) - sine * (east - x_m)
        return (along.abs() < length_m / 2 + grown_m) & (across.abs() < width_m / 2 + grown_m)

    own = (placement.x_m, placement.y_m, placement.heading_rad, vehicle.length_m, vehicle.width_m)
    shown = within(own, grown_m)
    for other in vehicle.others:
        shown &= ~within(other, 0.0)
    return shown


def _fault(
    vehicle: RemovedVehicle, tile: BackgroundTile, cleared: BackgroundSet, size_px: int
) -> str | None:
    """Says why a vehicle cannot be fitted; None if it can be."""
    if vehicle.heading_rad is None or vehicle.length_m is None or vehicle.width_m is None:
        return "its heading is not known"
    if vehicle.length_m / cleared.gsd_m < LEAST_PX:
        return f"it is shorter than {LEAST_PX:g} px"
    if min(tile.width_px, tile.height_px) < size_px:
        return "its tile is smaller than its window"
    light = tile.light or cleared.light
    if light.sun is None and min(light.sky) < _OVERCAST_FROM:
        return "the sun of its photograph is not known"
    return None


def _photographed(
    number: int, tile: BackgroundTile, cleared: BackgroundSet, size_px: int
) -> Photographed:
    gsd_m = cleared.gsd_m
    vehicle = tile.removed[number]
    # On whole pixels, which are copied exactly; at the tile's edge the window is moved inside.
    half = size_px // 2
    centre_x_px = min(max(round(vehicle.x_px), half), tile.width_px - half)
    centre_y_px = min(max(round(vehicle.y_px), half), tile.height_px - half)
    window = BackgroundWindow(tile.id, centre_x_px, centre_y_px, 0.0)

    def rectangle(stood: RemovedVehicle) -> Rectangle:
        return (
            (stood.x_px - centre_x_px) * gsd_m,
            (centre_y_px - stood.y_px) * gsd_m,
            stood.heading_rad or 0.0,
            stood.length_m or 0.0,
            stood.width_m or 0.0,
        )

    x_m, y_m, heading_rad, length_m, width_m = rectangle(vehicle)
    name = f"{tile.id}-{number:03d}"
    light: Light = tile.light or cleared.light
    placements = [Placement(name, x_m, y_m, heading_rad)]
    sizes_m = {name: (length_m, width_m, 1.5)}
    sunny = light.sun is not None
    standing_there = standing(
        placements, cleared, window, sizes_m, shadows=sunny, on_top_from=math.inf
    )
    scene = Scene(
        id=name,
        background=window,
        camera=Camera(0.0, 0.0, gsd_m, size_px),
        sun=_ANY_SUN if light.sun is None else light.sun.sun,
        placements=standing_there,
        seed=number,
    )
    others = tuple(
        rectangle(other)
        for index, other in enumerate(tile.removed)
        if index != number
        and math.dist((other.x_px, other.y_px), (vehicle.x_px, vehicle.y_px)) < size_px
    )
    assert vehicle.heading_from is not None
    return Photographed(scene, vehicle.heading_from, length_m, width_m, others)


def _nothing(cleared: BackgroundSet, left_out: dict[str, int]) -> str:
    if not left_out:
        return (
            f"{cleared.folder} says of no vehicle where it stood; label the vehicles of the "
            "imagery, and clear it again."
        )
    reasons = ", ".join(f"{count} because {why}" for why, count in left_out.items())
    return (
        f"No vehicle of {cleared.folder} can be fitted ({reasons}); give finer imagery, or such "
        "whose labels and shadows tell headings and sun."
    )
