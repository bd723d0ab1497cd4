"""Procedural aerial pictures of ground without vehicles, for where no imagery is given."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from skyproof.ground.built_up import draw_car_park, draw_crossroads, draw_street, draw_yard
from skyproof.ground.canvas import Canvas
from skyproof.ground.open_country import draw_fields, draw_park, draw_village
from skyproof.ground.photograph import GroundSensor, photograph
from skyproof.scenes.light import Light
from skyproof.scenes.sensor import Sensor


@dataclass(frozen=True)
class Ground:
    """A drawn tile.

    Attributes:
        image: `[3, H, W]` sRGB bytes.
        kind: what it shows.
        light: the light it lies in, and how the picture shows it.
        sensor: the blur and noise it was photographed with.
        directions: `[H, W]` map of drivable ground, as `skyproof.scenes.directions` says.
        shade: `[H, W]` map of the shadows in it, as `BackgroundTile.shade` says.
        cover: `[H, W]` map of what hides the ground, as `BackgroundTile.cover` says.
    """

    image: UInt8[Tensor, "3 H W"]
    kind: str
    light: Light
    sensor: Sensor
    directions: UInt8[np.ndarray, "H W"]
    shade: UInt8[np.ndarray, "H W"]
    cover: UInt8[np.ndarray, "H W"]


def draw_ground(
    size_px: int, gsd_m: float, *, generator: torch.Generator
) -> UInt8[Tensor, "3 H W"]:
    """Draws a tile of a random kind; see `draw_ground_and_sun`."""
    return draw_ground_and_sun(size_px, gsd_m, generator=generator).image


def draw_ground_and_sun(size_px: int, gsd_m: float, *, generator: torch.Generator) -> Ground:
    """Draws a tile of a random kind, one of `GROUND_KINDS`.

    Everything is drawn as reflectance and height; one sun lights it, shadows follow from the
    heights, then a random sensor photographs it (haze, tint, blur, noise). There are no vehicles,
    but many things of a vehicle's size. Where vehicles may stand is known: in lanes and along
    kerbs, in bays, drives and yards, on tracks; nowhere in a park.

    Args:
        size_px: the tile is size_px x size_px.
        gsd_m: metres per pixel.
        generator: one draw is taken from it.
    """
    seed = int(torch.randint(2**62, (1,), generator=generator))
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(list(GROUND_KINDS), p=[KIND_SHARES[name] for name in GROUND_KINDS]))
    canvas = Canvas(size_px, gsd_m, rng, axes_rad=float(rng.uniform(0, 2 * math.pi)))
    GROUND_KINDS[kind](canvas)
    canvas.mute(float(rng.uniform(0.35, 1.0)))
    camera = GroundSensor.draw(rng)
    picture = photograph(canvas, camera)
    sensor = Sensor(round(camera.blur_px, 3), round(camera.noise, 5))
    image = torch.from_numpy(picture.image)
    return Ground(
        image,
        kind,
        picture.light,
        sensor,
        canvas.drivable(),
        picture.shade,
        canvas.cover(camera.blur_px),
    )


GROUND_KINDS: dict[str, Callable[[Canvas], None]] = {
    "car park": draw_car_park,
    "crossroads": draw_crossroads,
    "fields": draw_fields,
    "park": draw_park,
    "street": draw_street,
    "village": draw_village,
    "yard": draw_yard,
}
"""What `draw_ground` draws."""

KIND_SHARES: dict[str, float] = {
    "car park": 0.2,
    "crossroads": 0.15,
    "fields": 0.08,
    "park": 0.08,
    "street": 0.2,
    "village": 0.14,
    "yard": 0.15,
}
"""How often each is drawn: more often where vehicles are found and things look like them."""
