"""A procedural aerial picture of ground without vehicles: what detectors train on where no imagery is given."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from skyproof.scenes.ground_canvas import Array, Canvas, Colour, Patch, Sensor, reflectance
from skyproof.scenes.ground_objects import (
    add_building,
    add_bush,
    add_clutter,
    add_hedge,
    add_lamp_post,
    add_manhole,
    add_tree,
    pick,
)

__all__ = ["GROUND_KINDS", "Ground", "draw_ground", "draw_ground_and_sun"]

ASPHALT: tuple[Colour, ...] = ((108, 108, 110), (92, 92, 95), (124, 122, 120), (80, 81, 85), (136, 132, 126))
PAVING: tuple[Colour, ...] = ((160, 156, 148), (148, 142, 136), (172, 164, 150), (134, 132, 132))
GRASS: tuple[Colour, ...] = ((96, 112, 62), (84, 104, 58), (120, 124, 74), (138, 132, 88), (76, 98, 52))
SOIL: tuple[Colour, ...] = ((150, 124, 96), (134, 108, 84), (170, 146, 116), (164, 100, 70), (120, 98, 80))
CONCRETE: tuple[Colour, ...] = ((168, 166, 160), (150, 148, 144), (180, 176, 166))


@dataclass(frozen=True)
class Ground:
    """A drawn tile, `[3, H, W]` sRGB bytes, with its kind and the sun its shadows were cast by (as in `Sun`)."""

    image: UInt8[Tensor, "3 H W"]
    kind: str
    sun_azimuth_rad: float
    sun_elevation_rad: float


def draw_ground(size_px: int, gsd_m: float, *, generator: torch.Generator) -> UInt8[Tensor, "3 H W"]:
    """Draws a tile of a random kind; see `draw_ground_and_sun`."""
    return draw_ground_and_sun(size_px, gsd_m, generator=generator).image


def draw_ground_and_sun(size_px: int, gsd_m: float, *, generator: torch.Generator) -> Ground:
    """Draws a tile of a random kind: a car park, a street, a crossroads, fields, a yard, a village or a park.

    Everything is drawn as reflectance and height; one sun lights it, shadows follow from the heights, then a random
    sensor photographs it (haze, tint, blur, noise). There are no vehicles, but many things of a vehicle's size.

    Args:
        size_px: the tile is size_px x size_px.
        gsd_m: metres per pixel.
        generator: one draw is taken from it.
    """
    seed = int(torch.randint(2**62, (1,), generator=generator))
    rng = np.random.default_rng(seed)
    names = tuple(GROUND_KINDS)
    kind = names[int(rng.integers(len(names)))]
    canvas = Canvas(size_px, gsd_m, rng, frame_rad=float(rng.uniform(0, 2 * math.pi)))
    GROUND_KINDS[kind](canvas)
    image = torch.from_numpy(canvas.photograph(Sensor.draw(rng)))
    return Ground(image, kind, canvas.sun_azimuth_rad, canvas.sun_elevation_rad)


def _lay_asphalt(canvas: Canvas, patch: Patch) -> None:
    """Asphalt with wear, patches of other age, cracks and oil."""
    rng = canvas.rng
    colour = pick(canvas, ASPHALT)
    wear = (
        1
        + 0.05 * canvas.noise("grain", patch)
        + 0.06 * canvas.noise("mottle", patch)
        + 0.07 * canvas.noise("patch", patch)
    )
    canvas.paint(patch, colour * np.clip(wear, 0.5, 1.6)[..., None])
    crack = np.abs(canvas.noise("patch", patch) + 0.15 * canvas.noise("mottle", patch) - rng.uniform(-1, 1)) < 0.025
    canvas.shade(patch, np.where(crack, rng.uniform(0.7, 0.95), 1.0).astype(np.float32))
    reach = canvas.reach_m * 0.8
    for _ in range(int(rng.poisson(5))):
        place = (float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach)))
        size = (float(rng.uniform(1, 9)), float(rng.uniform(0.6, 3)))
        repair = canvas.rectangle(place, size, float(rng.choice([0, math.pi / 2])))
        _within(canvas, repair, patch, float(rng.uniform(0.75, 1.2)))
    for _ in range(int(rng.poisson(6))):
        place = (float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach)))
        _within(canvas, canvas.disc(place, float(rng.uniform(0.3, 1.6)), 0.3), patch, float(rng.uniform(0.65, 0.9)))


def _within(canvas: Canvas, spot: Patch, ground: Patch, factor: float) -> None:
    """Shades a spot only where `ground` (a whole-canvas patch) lies."""
    if not spot.empty:
        canvas.shade(spot, 1 + (factor - 1) * ground.coverage[spot.rows, spot.columns])


def _lay_grass(canvas: Canvas, patch: Patch) -> None:
    """Grass of two tones with bare and mown places."""
    blend = np.clip(0.5 + 0.5 * canvas.noise("patch", patch) + 0.25 * canvas.noise("mottle", patch), 0, 1)[..., None]
    colour = pick(canvas, GRASS) * blend + pick(canvas, GRASS) * (1 - blend)
    bare = np.clip(canvas.noise("patch", patch) + 0.4 * canvas.noise("mottle", patch) - 1.3, 0, 0.8)[..., None]
    colour = colour + bare * (pick(canvas, SOIL) - colour)
    texture = 1 + 0.10 * canvas.noise("grain", patch) + 0.08 * canvas.noise("clump", patch)
    canvas.paint(patch, (colour * np.clip(texture, 0.3, 2)[..., None]).astype(np.float32))


def _lay_soil(canvas: Canvas, patch: Patch) -> None:
    """Bare soil or gravel, weeds in places."""
    colour = (
        pick(canvas, SOIL)
        * np.clip(
            1
            + 0.07 * canvas.noise("grain", patch)
            + 0.10 * canvas.noise("mottle", patch)
            + 0.1 * canvas.noise("patch", patch),
            0.4,
            2,
        )[..., None]
    )
    weeds = np.clip(0.6 * canvas.noise("mottle", patch) + 0.5 * canvas.noise("patch", patch) - 0.9, 0, 1)[..., None]
    canvas.paint(patch, (colour + weeds * (pick(canvas, GRASS) - colour)).astype(np.float32))


def _lay_paving(canvas: Canvas, patch: Patch, colours: tuple[Colour, ...] = PAVING, slab_m: float = 0.6) -> None:
    """Slabs with joints; large ones make a concrete yard."""
    joints = (np.mod(patch.u, slab_m) < 0.06 + 0.01 * slab_m) | (np.mod(patch.v, slab_m) < 0.06 + 0.01 * slab_m)
    texture = (
        1
        + 0.04 * canvas.noise("grain", patch)
        + 0.07 * canvas.noise("mottle", patch)
        + 0.05 * canvas.noise("patch", patch)
    )
    texture = np.clip(texture, 0.4, 2) * np.where(joints, 0.85, 1.0)
    canvas.paint(patch, (pick(canvas, colours) * texture[..., None]).astype(np.float32))


def _mark(canvas: Canvas, patch: Patch, colour: Colour = (232, 230, 222)) -> None:
    """Road paint, worn in places."""
    if not patch.empty:
        worn = np.clip(canvas.rng.uniform(0.55, 0.95) + 0.22 * canvas.noise("mottle", patch), 0.1, 1)
        canvas.paint(patch, reflectance(colour), worn)


def _add_road(canvas: Canvas, ground: Patch, centre_v_m: float, width_m: float, *, pavement_m: float) -> None:
    """A road along u with kerbs, pavements and lane lines."""
    rng = canvas.rng
    if pavement_m:
        _lay_paving(canvas, canvas.band(ground, centre_v_m, width_m + 2 * pavement_m))
        canvas.paint(canvas.band(ground, centre_v_m, width_m + 0.3), pick(canvas, ((186, 182, 174), (160, 158, 154))))
    road = canvas.band(ground, centre_v_m, width_m, 0.0 if pavement_m else 0.15)
    _lay_asphalt(canvas, road)
    wheel_tracks = 1 - 0.06 * np.cos(2 * math.pi * road.v / 1.75) * (np.abs(road.v) < width_m / 2)
    canvas.shade(road, wheel_tracks.astype(np.float32))
    style = rng.choice(["none", "dashed", "solid"], p=[0.3, 0.5, 0.2])
    lanes = max(2, round(width_m / 3.4))
    for lane in range(1, lanes):
        v_m = (lane / lanes - 0.5) * width_m
        line = canvas.band(road, v_m, 0.14)
        if style == "solid":
            _mark(canvas, line)
        elif style == "dashed":
            dash = (np.mod(line.u, 9.0 if lanes > 2 else 6.0) < 3.0).astype(np.float32)
            canvas.paint(line, reflectance((226, 224, 216)), dash * 0.8)
    if rng.random() < 0.4:
        for side in (-1, 1):
            _mark(
                canvas,
                canvas.band(road, side * (width_m / 2 - 0.35), 0.12),
                (226, 210, 120) if rng.random() < 0.3 else (226, 224, 216),
            )
    for _ in range(int(rng.integers(1, 6))):
        add_manhole(
            canvas, (float(rng.uniform(-1, 1)) * canvas.reach_m, centre_v_m + float(rng.uniform(-0.4, 0.4)) * width_m)
        )


def _add_street_furniture(canvas: Canvas, v_m: float) -> None:
    """Lamp posts and street trees in a row along u."""
    rng = canvas.rng
    spacing, start = float(rng.uniform(9, 22)), float(rng.uniform(0, 9))
    trees = rng.random() < 0.6
    for u_m in np.arange(-canvas.reach_m + start, canvas.reach_m, spacing):
        if trees and rng.random() < 0.7:
            add_tree(canvas, (float(u_m), v_m), float(rng.uniform(1.2, 3.6)))
        elif rng.random() < 0.5:
            add_lamp_post(canvas, (float(u_m), v_m))


def _draw_street(canvas: Canvas) -> None:
    """A residential street: plots with houses, drives, gardens, sheds, hedges, pools."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0, 1.0)))
    _lay_grass(canvas, ground)
    width, pavement = float(rng.uniform(5, 7.5)), float(rng.uniform(1.2, 2.4))
    centre = float(rng.uniform(-10, 10))
    _add_road(canvas, ground, centre, width, pavement_m=pavement)
    front = width / 2 + pavement
    verge = float(rng.uniform(3, 8))
    roof = str(rng.choice(["tiled", "tiled", "tiled", "metal", "flat"]))
    for side in (-1, 1):
        u_m = -canvas.reach_m
        while u_m < canvas.reach_m:
            plot, depth = float(rng.uniform(12, 20)), float(rng.uniform(8, 12))
            house_v = centre + side * (front + verge + depth / 2)
            drive_u = u_m + 2.0
            drive = canvas.rectangle((drive_u, centre + side * (front + (verge + depth) / 2)), (3.0, verge + depth))
            if not drive.empty and rng.random() < 0.8:
                _lay_paving(canvas, drive, PAVING + CONCRETE + ((150, 90, 74),), 0.4)
            house = (plot - float(rng.uniform(5, 7)), depth)
            wing = float(rng.choice([0, math.pi / 2])) if abs(house[0] - depth) < 3 else 0.0
            add_building(canvas, (u_m + 3.8 + house[0] / 2, house_v), house, wing, roof)
            back = house_v + side * (depth / 2 + 6)
            for _ in range(int(rng.integers(0, 4))):
                spot = (u_m + float(rng.uniform(0, plot)), back + float(rng.uniform(-4, 6)))
                add_clutter(
                    canvas,
                    spot,
                    float(rng.choice([0, math.pi / 2])),
                    ("shed", "shed", "pool", "tarpaulin", "bench", "skip"),
                )
            for _ in range(int(rng.integers(0, 4))):
                add_tree(
                    canvas,
                    (u_m + float(rng.uniform(0, plot)), back + float(rng.uniform(-3, 8))),
                    float(rng.uniform(1, 4)),
                )
            if rng.random() < 0.6:
                add_hedge(canvas, (u_m, house_v + side * 5), depth + 14, math.pi / 2)
            if rng.random() < 0.4:
                add_clutter(
                    canvas,
                    (drive_u, centre + side * (front + verge)),
                    math.pi / 2,
                    ("bins", "painted box", "skip", "tarpaulin"),
                )
            if rng.random() < 0.5:
                add_bush(canvas, (u_m + plot / 2, centre + side * (front + 1.5)), float(rng.uniform(0.5, 1.6)))
            u_m += plot
        if rng.random() < 0.7:
            _add_street_furniture(canvas, centre + side * (front + 0.8))


def _draw_crossroads(canvas: Canvas) -> None:
    """Two roads that meet, with stop lines, crossings, islands and buildings on the corners."""
    rng = canvas.rng
    ground = canvas.everywhere()
    (_lay_grass if rng.random() < 0.5 else _lay_paving)(canvas, ground)
    across = canvas.everywhere(math.pi / 2 + float(rng.normal(0, 0.15)))
    widths = float(rng.uniform(6, 15)), float(rng.uniform(6, 13))
    pavement = float(rng.uniform(1.5, 4))
    for side_u in (-1, 1):
        for side_v in (-1, 1):
            size = (float(rng.uniform(12, 24)), float(rng.uniform(10, 18)))
            place = (
                side_u * (widths[1] / 2 + pavement + 3 + size[0] / 2),
                side_v * (widths[0] / 2 + pavement + 2 + size[1] / 2),
            )
            draw = rng.random()
            if draw < 0.6:
                add_building(canvas, place, size, 0.0, str(rng.choice(["flat", "tiled", "metal"])))
            elif draw < 0.9:
                for _ in range(int(rng.integers(2, 8))):
                    spot = (place[0] + float(rng.uniform(-7, 7)), place[1] + float(rng.uniform(-6, 6)))
                    add_tree(canvas, spot, float(rng.uniform(1.5, 4.5)))
    _add_road(canvas, across, 0.0, widths[1], pavement_m=pavement)
    _add_road(canvas, ground, 0.0, widths[0], pavement_m=pavement)
    for patch, width, other in ((ground, widths[0], widths[1]), (across, widths[1], widths[0])):
        crossing = canvas.band(patch, 0.0, width - 0.6)
        _lay_over_crossing(canvas, crossing, other)
    for _ in range(int(rng.integers(1, 4))):
        spot = (float(rng.choice([-1, 1])) * (widths[1] / 2 + 6), float(rng.normal(0, widths[0] / 3)))
        add_clutter(canvas, spot, 0.0, ("painted box", "painted box", "skip", "pallets"))
    for side in (-1, 1):
        _add_street_furniture(canvas, side * (widths[0] / 2 + 1.0))


def _lay_over_crossing(canvas: Canvas, road: Patch, other_width_m: float) -> None:
    """Wipes lane lines from the junction and marks stop lines and zebra crossings before it."""
    rng = canvas.rng
    for side in (-1, 1):
        start = other_width_m / 2 + 2.5
        along = side * road.u - start
        if rng.random() < 0.5:
            stripes = (along > 0) & (along < 3.0) & (np.mod(road.v, 1.0) < 0.5)
            canvas.paint(road, reflectance((230, 228, 220)), stripes * 0.85)
            along = along - 4.0
        stop = (along > 0) & (along < 0.4) & (side * road.v < 0)
        canvas.paint(road, reflectance((230, 228, 220)), stop * 0.85)


def _draw_car_park(canvas: Canvas) -> None:
    """Rows of painted bays with aisles, planted islands, and what stands about in car parks."""
    rng = canvas.rng
    ground = canvas.everywhere()
    _lay_asphalt(canvas, ground)
    bay_m, length_m, aisle_m = float(rng.uniform(2.3, 2.7)), float(rng.uniform(4.6, 5.4)), float(rng.uniform(5.5, 7.5))
    period, offset = 2 * length_m + aisle_m, float(rng.uniform(0, 15))
    slant = float(rng.choice([0.0, 0.0, 0.35]))
    lines = str(rng.choice(["white", "white", "yellow", "faint"]))
    colour: Colour = (226, 200, 90) if lines == "yellow" else (232, 230, 224)
    strength = 0.3 if lines == "faint" else float(rng.uniform(0.6, 0.95))
    v = np.mod(ground.v + offset, period)
    u = ground.u + slant * v
    in_bays = v < 2 * length_m
    thin = 0.055 + canvas.gsd_m / 4
    dividers = in_bays & (np.abs(np.mod(u, bay_m) - bay_m / 2) < thin)
    spine = np.abs(v - length_m) < thin
    worn = np.clip(strength + 0.2 * canvas.noise("mottle", ground), 0.05, 1)
    canvas.paint(ground, reflectance(colour), (dividers | spine) * worn)
    stains = in_bays & (canvas.noise("mottle", ground) > 1.4)
    canvas.shade(ground, np.where(stains, 0.85, 1).astype(np.float32))
    for row in range(int(-canvas.reach_m // period) - 1, int(canvas.reach_m // period) + 2):
        spine_v = row * period + length_m - offset
        planted = rng.random() < 0.4
        if planted:
            strip = canvas.band(ground, spine_v, 1.6)
            canvas.paint(canvas.band(ground, spine_v, 1.9), reflectance((176, 172, 164)))
            _lay_grass(canvas, strip)
        for u_m in np.arange(-canvas.reach_m, canvas.reach_m, bay_m):
            bay = (float(u_m), spine_v + float(rng.choice([-1, 1])) * length_m / 2)
            draw = rng.random()
            if draw < 0.04:
                add_clutter(
                    canvas, bay, math.pi / 2, ("painted box", "skip", "tarpaulin", "pallets", "container", "bins")
                )
            elif draw < 0.10:
                canvas.shade(
                    canvas.rectangle(bay, (bay_m - 0.3, length_m - 0.6), 0.0, 0.5), float(rng.uniform(0.8, 0.93))
                )
            elif draw < 0.15 and planted:
                add_tree(canvas, (float(u_m), spine_v), float(rng.uniform(1.2, 3.2)))
            elif draw < 0.17:
                add_lamp_post(canvas, (float(u_m), spine_v))
    if rng.random() < 0.6:
        size = (float(rng.uniform(20, 60)), float(rng.uniform(12, 25)))
        side = float(rng.choice([-1, 1])) * float(rng.uniform(20, 32))
        _lay_paving(canvas, canvas.rectangle((0.0, side), (size[0] + 8, size[1] + 8)))
        add_building(canvas, (float(rng.uniform(-10, 10)), side), size, 0.0, str(rng.choice(["flat", "metal"])))


def _draw_yard(canvas: Canvas) -> None:
    """An industrial yard: halls, a concrete or gravel ground, containers, pallets, skips."""
    rng = canvas.rng
    ground = canvas.everywhere()
    draw = rng.random()
    if draw < 0.45:
        _lay_paving(canvas, ground, CONCRETE, float(rng.uniform(3, 6)))
    elif draw < 0.8:
        _lay_asphalt(canvas, ground)
    else:
        _lay_soil(canvas, ground)
    for _ in range(int(rng.integers(1, 4))):
        place = (float(rng.uniform(-28, 28)), float(rng.choice([-1, 1])) * float(rng.uniform(12, 30)))
        size = (float(rng.uniform(14, 40)), float(rng.uniform(10, 24)))
        add_building(canvas, place, size, 0.0, str(rng.choice(["metal", "flat", "metal", "village"])))
    kinds = ("container", "container", "pallets", "skip", "painted box", "tarpaulin", "air conditioner", "shed", "bins")
    for _ in range(int(rng.integers(8, 26))):
        place = (float(rng.uniform(-1, 1)) * canvas.reach_m, float(rng.normal(0, 9)))
        if canvas.base_height(place) < 0.5:
            add_clutter(canvas, place, float(rng.choice([0, math.pi / 2])), kinds)
    for _ in range(int(rng.integers(0, 4))):
        add_tree(canvas, (float(rng.uniform(-30, 30)), float(rng.uniform(-30, 30))), float(rng.uniform(1.5, 4)))


def _draw_fields(canvas: Canvas) -> None:
    """Crops, meadow and soil divided by a track with bushes along it."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0, 2.5)))
    track_v = float(rng.uniform(-15, 15))
    (_lay_grass if rng.random() < 0.6 else _lay_soil)(canvas, ground)
    for side in (-1, 1):
        if rng.random() < 0.6:
            half = Patch(
                ground.rows,
                ground.columns,
                ground.u,
                ground.v,
                ground.inside,
                np.clip(0.5 + (side * (ground.v - track_v) - 3) / 0.5, 0, 1).astype(np.float32),
            )
            (_lay_soil if rng.random() < 0.5 else _lay_grass)(canvas, half)
            rows = 1 + rng.uniform(0.05, 0.3) * np.sin(2 * math.pi * ground.v / rng.uniform(0.5, 1.6)) * np.clip(
                1 + 0.5 * canvas.noise("patch", ground), 0, 1.5
            )
            canvas.shade(half, rows.astype(np.float32))
    width = float(rng.uniform(2.6, 5))
    draw = rng.random()
    if draw < 0.35:
        _add_road(canvas, ground, track_v, width, pavement_m=0)
    elif draw < 0.85:
        tracks: Array = pick(canvas, SOIL)
        for v_m in (-0.9, 0.9):
            rut = canvas.band(ground, track_v + v_m, 0.9, 0.15)
            texture = 1 + 0.1 * canvas.noise("grain", rut) + 0.1 * canvas.noise("mottle", rut)
            canvas.paint(rut, (tracks * np.clip(texture, 0.3, 2)[..., None]).astype(np.float32))
    for _ in range(int(rng.integers(3, 22))):
        near_track = rng.random() < 0.6
        v_m = (
            track_v + float(rng.choice([-1, 1])) * float(rng.uniform(3.5, 6))
            if near_track
            else float(rng.uniform(-35, 35))
        )
        place = (float(rng.uniform(-1, 1)) * canvas.reach_m, v_m)
        if rng.random() < 0.55:
            add_bush(canvas, place, float(rng.uniform(0.5, 2.2)))
        else:
            add_tree(canvas, place, float(rng.uniform(1.5, 5)))
    for _ in range(int(rng.integers(0, 5))):
        place = (float(rng.uniform(-30, 30)), track_v + float(rng.uniform(-12, 12)))
        add_clutter(canvas, place, 0.0, ("tarpaulin", "shed", "pallets", "container", "skip"))


def _draw_village(canvas: Canvas) -> None:
    """Houses with sheet roofs at all angles on bare soil, as in fast-growing towns."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0.5, 3)))
    _lay_soil(canvas, ground)
    road = canvas.band(ground, float(rng.uniform(-12, 12)), float(rng.uniform(3.5, 6)), 0.3)
    (_lay_soil if rng.random() < 0.7 else _lay_asphalt)(canvas, road)
    for u_m in np.arange(-canvas.reach_m, canvas.reach_m, 13.0):
        for v_m in np.arange(-canvas.reach_m, canvas.reach_m, 13.0):
            place = (float(u_m + rng.uniform(-3, 3)), float(v_m + rng.uniform(-3, 3)))
            column, row = (int(np.clip(p, 0, canvas.pixels - 1)) for p in canvas.to_pixels(*place))
            if road.inside[row, column] > -4:
                continue
            angle = float(rng.normal(0, 0.12)) + float(rng.choice([0, math.pi / 2]))
            draw = rng.random()
            if draw < 0.72:
                size = (float(rng.uniform(6, 13)), float(rng.uniform(4, 9)))
                add_building(canvas, place, size, angle, str(rng.choice(["village", "village", "tiled", "metal"])))
            elif draw < 0.85:
                add_clutter(canvas, place, angle, ("shed", "tarpaulin", "bins", "pallets", "painted box"))
            for _ in range(int(rng.integers(0, 3))):
                spot = (place[0] + float(rng.uniform(-7, 7)), place[1] + float(rng.uniform(-7, 7)))
                (add_tree if rng.random() < 0.6 else add_bush)(canvas, spot, float(rng.uniform(0.8, 3.0)))


def _draw_park(canvas: Canvas) -> None:
    """Lawns, paths, woods, a painted court."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(1, 5)))
    _lay_grass(canvas, ground)
    for centre in (float(rng.uniform(-20, 0)), float(rng.uniform(0, 20))):
        path = canvas.band(ground, centre, float(rng.uniform(1.5, 3.5)), 0.1)
        (_lay_soil if rng.random() < 0.5 else _lay_asphalt)(canvas, path)
    if rng.random() < 0.5:
        place = (float(rng.uniform(-15, 15)), float(rng.uniform(-15, 15)))
        court = canvas.rectangle(place, (24, 13))
        canvas.paint(court, pick(canvas, ((120, 60, 50), (50, 90, 80), (60, 80, 120), (120, 120, 120))))
        for inset in (1.0, 2.4):
            line = canvas.rectangle(place, (24 - 2 * inset, 13 - 2 * inset))
            if not line.empty:
                canvas.paint(line, reflectance((226, 226, 220)), (np.abs(line.inside) < 0.08).astype(np.float32) * 0.9)
    woods = float(rng.uniform(0.2, 1.6))
    for _ in range(int(rng.integers(10, 50))):
        place = (float(rng.uniform(-1, 1)) * canvas.reach_m, float(rng.uniform(-1, 1)) * canvas.reach_m)
        if canvas.noise("patch").flat[0] < woods:
            add_tree(canvas, place, float(rng.uniform(1.2, 5)))
    for _ in range(int(rng.integers(2, 9))):
        place = (float(rng.uniform(-25, 25)), float(rng.uniform(-25, 25)))
        add_clutter(
            canvas,
            place,
            float(rng.uniform(0, math.pi)),
            ("bench", "bench", "bins", "shed", "tarpaulin", "painted box"),
        )


GROUND_KINDS: dict[str, Callable[[Canvas], None]] = {
    "car park": _draw_car_park,
    "crossroads": _draw_crossroads,
    "fields": _draw_fields,
    "park": _draw_park,
    "street": _draw_street,
    "village": _draw_village,
    "yard": _draw_yard,
}
"""What `draw_ground` draws, each as likely as the others."""
