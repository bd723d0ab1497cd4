"""Places vehicles as in the photograph: where vehicles were removed, or on drivable ground."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from shapely import Polygon

from skyproof.errors import ConfigurationError
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet, read_map
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.scene import BackgroundWindow, Placement
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.standing import Sizes, footprint

SHIFT_M = 0.3
TURN_RAD = math.radians(3)
"""Standard deviations of a vehicle's place and heading around the given ones."""
NEAR_LENGTH_SHARE = 1 / 3
"""Share of the vehicles, nearest in length to a removed one, from which its successor is drawn."""

_TILES_TRIED = 60
_WINDOWS_TRIED = 20
_VEHICLES_TRIED = 5
_POINTS = 1024
_POINTS_USED = 64


@dataclass(frozen=True)
class Place:
    """A possible place of a vehicle, in metres from the image's middle."""

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float | None = None


@dataclass(frozen=True)
class SceneDraw:
    """What the draws of one scene share; `half_m` bounds vehicle centres on both axes."""

    settings: SceneSettings
    backgrounds: BackgroundSet
    split: str
    sizes_m: Sizes
    half_m: float
    generator: torch.Generator

    def number(self) -> int:
        """Draws the number of vehicles."""
        least = self.settings.vehicles_minimum
        span = self.settings.vehicles_maximum - least + 1
        return least + int(torch.randint(span, (1,), generator=self.generator))

    def uniforms(self, *shape: int) -> list[Any]:
        """Draws numbers from 0 to 1."""
        return torch.rand(*shape, dtype=torch.float64, generator=self.generator).tolist()

    def inside(self, at: Placement | Place) -> bool:
        """Whether a vehicle's centre is inside the margin."""
        return max(abs(at.x_m), abs(at.y_m)) <= self.half_m


def place_vehicles(draw: SceneDraw) -> tuple[BackgroundWindow, tuple[Placement, ...]]:
    """Draws a window and vehicles at places on its ground; none overlap.

    The tile is drawn uniformly from those with places, and the window from those with room for the
    smallest number of vehicles (at least one). Vehicles take a random subset of its places.
    """
    settings, backgrounds, generator = draw.settings, draw.backgrounds, draw.generator
    number = draw.number()
    if number == 0:
        return backgrounds.sample_window(draw.split, settings.size_px, generator=generator), ()
    tiles = _tiles_with_places(draw)
    least = max(settings.vehicles_minimum, 1)
    for _ in range(_TILES_TRIED):
        tile = tiles[int(torch.randint(len(tiles), (1,), generator=generator))]
        for _ in range(_WINDOWS_TRIED):
            window = backgrounds.sample_window_on(tile, settings.size_px, generator=generator)
            if settings.places == "removed":
                places = _removed_places(tile, window, backgrounds.gsd_m)
            else:
                places = _drivable_places(draw, window)
            placements = _fill(draw, [place for place in places if draw.inside(place)], number)
            if len(placements) >= least:
                return window, placements
    raise ConfigurationError(
        f"No window of {settings.size_px} px on the {draw.split} tiles of {backgrounds.folder} has "
        f"{settings.places} places for {least} vehicles; give fewer vehicles, a larger image, or "
        "--settings.places uniform."
    )


def _tiles_with_places(draw: SceneDraw) -> list[BackgroundTile]:
    tiles = draw.backgrounds.window_tiles(draw.split, draw.settings.size_px)
    if draw.settings.places == "removed":
        tiles = [tile for tile in tiles if known_places(tile)]
        what, remedy = "removed vehicles", "clear labelled imagery with skyproof clear"
    else:
        tiles = [tile for tile in tiles if tile.drivable is not None]
        what, remedy = "drivable ground", "draw or cut the ground again with skyproof ground"
    if not tiles:
        raise ConfigurationError(
            f"{draw.backgrounds.folder} knows no {what} on its {draw.split} tiles; {remedy}, or "
            "give --settings.places uniform."
        )
    return tiles


def known_places(tile: BackgroundTile) -> list[RemovedVehicle]:
    """Lists the vehicles removed from a tile whose heading is known."""
    return [one for one in tile.removed if one.heading_rad is not None]


def _removed_places(tile: BackgroundTile, window: BackgroundWindow, gsd_m: float) -> list[Place]:
    """Returns the places of removed vehicles in a window's axes; some may lie outside of it."""
    cosine, sine = math.cos(window.rotation_rad), math.sin(window.rotation_rad)
    places = []
    for one in known_places(tile):
        across, down = one.x_px - window.centre_x_px, one.y_px - window.centre_y_px
        # The window's x axis is the tile's turned to the left, so its content turns right.
        x_m, y_m = (cosine * across - sine * down) * gsd_m, -(sine * across + cosine * down) * gsd_m
        assert one.heading_rad is not None
        places.append(Place(x_m, y_m, one.heading_rad - window.rotation_rad, one.length_m))
    return places


def _drivable_places(draw: SceneDraw, window: BackgroundWindow) -> list[Place]:
    """Draws 1,024 points, and returns the first 64 on drivable ground."""
    backgrounds, half_m = draw.backgrounds, draw.half_m
    directions = backgrounds.directions(window.tile)
    points = torch.rand(_POINTS, 2, dtype=torch.float64, generator=draw.generator)
    if directions is None:
        return []
    x_m, y_m = ((2 * points - 1) * half_m).unbind(1)
    values = read_map(directions, window, x_m / backgrounds.gsd_m, y_m / backgrounds.gsd_m)
    hits = values.nonzero().flatten()[:_POINTS_USED]
    found = zip(x_m[hits].tolist(), y_m[hits].tolist(), values[hits].tolist(), strict=True)
    return [Place(x, y, math.radians(value - 1) - window.rotation_rad) for x, y, value in found]


def _fill(draw: SceneDraw, places: Sequence[Place], number: int) -> tuple[Placement, ...]:
    """Puts at most `number` vehicles on places, in random order."""
    taken: dict[Placement, Polygon] = {}
    for index in torch.randperm(len(places), generator=draw.generator).tolist():
        if len(taken) == number:
            break
        for placement in _draws(draw, places[index]):
            ground = footprint(placement, draw.sizes_m, draw.settings.gap_m)
            free = not any(map(ground.intersects, taken.values()))
            if draw.inside(placement) and free:
                taken[placement] = ground
                break
    return tuple(taken)


def _draws(draw: SceneDraw, place: Place) -> Iterator[Placement]:
    """Draws vehicles for a place, each slightly off it and facing either way."""
    generator = draw.generator
    names, length_m = sorted(draw.sizes_m), place.length_m
    if length_m is not None:
        names.sort(key=lambda name: abs(draw.sizes_m[name][0] - length_m))
        names = names[: math.ceil(len(names) * NEAR_LENGTH_SHARE)]
    for _ in range(_VEHICLES_TRIED):
        name = names[int(torch.randint(len(names), (1,), generator=generator))]
        (side,) = draw.uniforms(1)
        east, north, turn = torch.randn(3, dtype=torch.float64, generator=generator).tolist()
        heading_rad = place.heading_rad + TURN_RAD * turn + (math.pi if side < 0.5 else 0.0)
        x_m, y_m = place.x_m + SHIFT_M * east, place.y_m + SHIFT_M * north
        yield Placement(name, x_m, y_m, heading_rad % (2 * math.pi))
