"""The kinds of procedural ground: street, crossroads, car park, yard, fields, village, park."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from skyproof.ground.buildings import add_building
from skyproof.ground.canvas import Canvas, Patch, palette, reflectance
from skyproof.ground.clutter import (
    add_bush,
    add_clutter,
    add_hedge,
    add_lamp_post,
    add_stairs,
    add_stand,
    add_tree,
)
from skyproof.ground.surfaces import (
    ASPHALT,
    CONCRETE,
    PAVING,
    SOIL,
    add_pavement,
    add_road,
    add_street_furniture,
    allow_lanes,
    lay_asphalt,
    lay_grass,
    lay_paving,
    lay_soil,
    mark_guides,
)

_LINE = reflectance((230, 228, 220))
_STREET_THINGS = ("kiosk", "kiosk", "girders", "rubble", "bench", "bins")
_COURTS = palette("783c32 325a50 3c5078 787878")


def draw_street(canvas: Canvas) -> None:
    """Draws a residential street: plots with houses, drives, gardens, sheds, hedges, pools."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=rng.uniform(0, 1.0))
    lay_grass(canvas, ground)
    width_m = rng.uniform(5, 7.5)
    pavement_m = rng.uniform(1.2, 2.4)
    centre_v = rng.uniform(-10, 10)
    add_pavement(canvas, ground, centre_v, width_m, pavement_m)
    add_road(canvas, ground, centre_v, width_m)
    front_m = width_m / 2 + pavement_m
    verge_m = rng.uniform(3, 8)
    roof = canvas.either("tiled", "tiled", "tiled", "metal", "flat")
    for side in (-1, 1):
        u_m = -canvas.reach_m
        while u_m < canvas.reach_m:
            plot_m = rng.uniform(12, 20)
            _draw_plot(canvas, u_m, plot_m, centre_v, side, (front_m, verge_m), roof)
            u_m += plot_m
        if rng.random() < 0.7:
            add_street_furniture(canvas, centre_v + side * (front_m + 0.8))


def _draw_plot(
    canvas: Canvas,
    u_m: float,
    plot_m: float,
    centre_v: float,
    side: int,
    before_m: tuple[float, float],
    roof: str,
) -> None:
    """Draws a plot; `before_m` holds its distance from the middle of the road, and its verge."""
    rng = canvas.rng
    front_m, verge_m = before_m
    depth_m = rng.uniform(8, 12)
    house_v = centre_v + side * (front_m + verge_m + depth_m / 2)
    drive = (u_m + 2.0, centre_v + side * (front_m + (verge_m + depth_m) / 2))
    paved = canvas.rectangle(drive, (3.0, verge_m + depth_m))
    if not paved.empty and rng.random() < 0.8:
        lay_paving(canvas, paved, (*PAVING, *CONCRETE, (150, 90, 74)), 0.4)
        # A vehicle's middle stays half a vehicle from both ends of the drive.
        canvas.allow(canvas.rectangle(drive, (verge_m + depth_m - 5, 0.5), math.pi / 2))
    house_m = (plot_m - rng.uniform(5, 7), depth_m)
    wing_rad = canvas.either(0, math.pi / 2) if abs(house_m[0] - depth_m) < 3 else 0.0
    kind = roof if rng.random() < 0.8 else "tiled"
    add_building(canvas, (u_m + 3.8 + house_m[0] / 2, house_v), house_m, wing_rad, kind)
    back_v = house_v + side * (depth_m / 2 + 6)
    for _ in range(rng.integers(0, 4)):
        spot = (u_m + rng.uniform(0, plot_m), back_v + rng.uniform(-4, 6))
        kinds = ("shed", "shed", "pool", "tarpaulin", "bench", "skip")
        add_clutter(canvas, spot, canvas.either(0, math.pi / 2), *kinds)
    for _ in range(rng.integers(0, 4)):
        spot = (u_m + rng.uniform(0, plot_m), back_v + rng.uniform(-3, 8))
        add_tree(canvas, spot, rng.uniform(1, 4))
    if rng.random() < 0.15:
        add_stand(canvas, (u_m + plot_m / 2, back_v + side * 4), rng.uniform(3, 6))
    if rng.random() < 0.6:
        add_hedge(canvas, (u_m, house_v + side * 5), depth_m + 14, math.pi / 2)
    if rng.random() < 0.6:
        gate = (u_m + 2.0, centre_v + side * (front_m + verge_m))
        add_clutter(canvas, gate, math.pi / 2, "bins", "painted box", "skip", "tarpaulin", "rubble")
    if rng.random() < 0.5:
        spot = (u_m + plot_m / 2, centre_v + side * (front_m + 1.5))
        add_bush(canvas, spot, rng.uniform(0.5, 1.6))


def draw_crossroads(canvas: Canvas) -> None:
    """Draws two roads that meet, with stop lines, crossings and buildings on the corners."""
    rng = canvas.rng
    ground = canvas.everywhere()
    (lay_grass if rng.random() < 0.5 else lay_paving)(canvas, ground)
    across = canvas.everywhere(math.pi / 2 + rng.normal(0, 0.15))
    width_m, other_m = rng.uniform(6, 15), rng.uniform(6, 13)
    pavement_m = rng.uniform(1.5, 4)
    for side_u, side_v in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        size_m = (rng.uniform(12, 24), rng.uniform(10, 18))
        corner = (
            side_u * (other_m / 2 + pavement_m + 3 + size_m[0] / 2),
            side_v * (width_m / 2 + pavement_m + 2 + size_m[1] / 2),
        )
        draw = rng.random()
        if draw < 0.6:
            add_building(canvas, corner, size_m, 0.0, canvas.either("flat", "tiled", "metal"))
        elif draw < 0.85:
            add_stand(canvas, corner, rng.uniform(3, 9))
        elif draw < 0.95:
            u_m, v_m = other_m / 2 + pavement_m + 7, width_m / 2 + pavement_m + 2.6
            add_stairs(canvas, (side_u * u_m, side_v * v_m), canvas.either(0, math.pi))
    add_pavement(canvas, across, 0.0, other_m, pavement_m)
    add_pavement(canvas, ground, 0.0, width_m, pavement_m)
    colour = canvas.pick(ASPHALT)
    add_road(canvas, across, 0.0, other_m, colour=colour)
    add_road(canvas, ground, 0.0, width_m, colour=colour)
    first = canvas.band(ground, 0.0, width_m + 0.4)
    second = canvas.band(across, 0.0, other_m + 0.4)
    junction = dataclasses.replace(first, coverage=first.coverage * second.coverage)
    lay_asphalt(canvas, junction, colour)
    for along, own_m, crossed_m in ((ground, width_m, other_m), (across, other_m, width_m)):
        _mark_crossing(canvas, canvas.band(along, 0.0, own_m - 0.6), crossed_m)
    for _ in range(rng.integers(2, 7)):
        # Cycle paths and footpaths cross the roads, and lines guide vehicles that turn.
        place = (rng.uniform(-0.7, 0.7) * other_m, rng.uniform(-0.7, 0.7) * width_m)
        turn_rad = canvas.either(0, math.pi / 2, rng.uniform(0, math.pi))
        mark_guides(canvas, place, turn_rad, canvas.either(first, second, junction))
    for _ in range(rng.integers(1, 4)):
        spot = (canvas.either(-1, 1) * (other_m / 2 + 6), rng.normal(0, width_m / 3))
        add_clutter(canvas, spot, 0.0, "painted box", "painted box", "skip", "pallets")
    for _ in range(rng.integers(1, 5)):
        beside_v = canvas.either(-1, 1) * (width_m / 2 + rng.uniform(1.0, pavement_m + 5))
        spot = (rng.uniform(-1, 1) * canvas.reach_m, beside_v)
        if abs(spot[0]) > other_m / 2 + 3 and canvas.base_height(spot) < 0.5:
            add_clutter(canvas, spot, canvas.either(0, math.pi / 2), *_STREET_THINGS)
    for side in (-1, 1):
        add_street_furniture(canvas, side * (width_m / 2 + 1.0))


def _mark_crossing(canvas: Canvas, road: Patch, crossed_m: float) -> None:
    """Marks stop lines and zebra crossings before a junction."""
    for side in (-1, 1):
        along = side * road.u - (crossed_m / 2 + 2.5)
        if canvas.rng.random() < 0.5:
            stripes = (along > 0) & (along < 3.0) & (np.mod(road.v, 1.0) < 0.5)
            canvas.paint(road, _LINE, stripes * 0.85)
            along = along - 4.0
        stop = (along > 0) & (along < 0.4) & (side * road.v < 0)
        canvas.paint(road, _LINE, stop * 0.85)


def draw_car_park(canvas: Canvas) -> None:
    """Draws rows of painted bays with aisles, planted islands, and things in the bays."""
    rng = canvas.rng
    ground = canvas.everywhere()
    lay_asphalt(canvas, ground)
    bay_m = (rng.uniform(2.3, 2.7), rng.uniform(4.6, 5.4))
    period_m = 2 * bay_m[1] + rng.uniform(5.5, 7.5)
    offset_m = rng.uniform(0, 15)
    slant = canvas.either(0.0, 0.0, 0.35)
    lines = canvas.either("white", "white", "yellow", "faint")
    strength = 0.3 if lines == "faint" else rng.uniform(0.6, 0.95)
    v = np.mod(ground.v + offset_m, period_m)
    u = ground.u + slant * v
    in_bays = v < 2 * bay_m[1]
    thin_m = 0.055 + canvas.gsd_m / 4
    dividers = in_bays & (np.abs(np.mod(u, bay_m[0]) - bay_m[0] / 2) < thin_m)
    spine = np.abs(v - bay_m[1]) < thin_m
    worn = np.clip(strength + 0.2 * canvas.noise("mottle", ground), 0.05, 1)
    colour = reflectance((226, 200, 90) if lines == "yellow" else (232, 230, 224))
    canvas.paint(ground, colour, (dividers | spine) * worn)
    stains = in_bays & (canvas.noise("mottle", ground) > 1.4)
    canvas.shade(ground, np.where(stains, 0.85, 1))
    in_bay = np.abs(np.mod(u + bay_m[0] / 2, bay_m[0]) - bay_m[0] / 2) < 0.3
    rows = int(canvas.reach_m // period_m)
    for row in range(int(-canvas.reach_m // period_m) - 1, rows + 2):
        spine_v = row * period_m + bay_m[1] - offset_m
        planted = rng.random() < 0.4
        if planted:
            strip = canvas.band(ground, spine_v, 1.6)
            canvas.paint(canvas.band(ground, spine_v, 1.9), reflectance((176, 172, 164)))
            lay_grass(canvas, strip)
        # Vehicles park in the middle of the bays, off planted strips, and drive along the aisles.
        for half in (-1, 1):
            bays = ground.v - spine_v - half * (bay_m[1] / 2 + (0.5 if planted else 0.0))
            canvas.allow(ground, in_bay & (np.abs(bays) < 0.3), math.pi / 2 + math.atan(slant))
        canvas.allow(ground, np.abs(ground.v - spine_v - period_m / 2) < 0.06)
        _fill_bays(canvas, spine_v, bay_m, planted=planted)
    if rng.random() < 0.6:
        size_m = (rng.uniform(20, 60), rng.uniform(12, 25))
        side_v = canvas.either(-1, 1) * rng.uniform(20, 32)
        forecourt = canvas.rectangle((0.0, side_v), (size_m[0] + 8, size_m[1] + 8))
        lay_paving(canvas, forecourt)
        canvas.forbid(forecourt)
        place = (rng.uniform(-10, 10), side_v)
        add_building(canvas, place, size_m, 0.0, canvas.either("flat", "metal", "tiled"))
    if rng.random() < 0.3:
        add_stairs(canvas, (rng.uniform(-16, 16), rng.uniform(-16, 16)), canvas.either(0, math.pi))


def _fill_bays(
    canvas: Canvas, spine_v: float, bay_m: tuple[float, float], *, planted: bool
) -> None:
    """Puts things, stains, trees and lamp posts into some bays of width and length `bay_m`."""
    rng = canvas.rng
    for u_m in np.arange(-canvas.reach_m, canvas.reach_m, bay_m[0]).tolist():
        bay = (u_m, spine_v + canvas.either(-1, 1) * bay_m[1] / 2)
        draw = rng.random()
        if draw < 0.07:
            kinds = ("painted box", "skip", "tarpaulin", "pallets", "container", "bins")
            add_clutter(canvas, bay, math.pi / 2, *kinds)
        elif draw < 0.13:
            stain = canvas.rectangle(bay, (bay_m[0] - 0.3, bay_m[1] - 0.6), 0.0, 0.5)
            canvas.shade(stain, rng.uniform(0.8, 0.93))
        elif draw < 0.18 and planted:
            add_tree(canvas, (u_m, spine_v), rng.uniform(1.2, 3.2))
        elif draw < 0.20:
            add_lamp_post(canvas, (u_m, spine_v))


def draw_yard(canvas: Canvas) -> None:
    """Draws an industrial yard: halls, a concrete or gravel ground, containers, pallets, skips."""
    rng = canvas.rng
    ground = canvas.everywhere()
    draw = rng.random()
    if draw < 0.45:
        lay_paving(canvas, ground, CONCRETE, rng.uniform(3, 6))
    elif draw < 0.8:
        lay_asphalt(canvas, ground)
    else:
        lay_soil(canvas, ground)
    # Vehicles stand along the halls in some rows and across in others.
    along = np.mod(ground.v, 16.0) < 8.0
    canvas.allow(ground, along)
    canvas.allow(ground, ~along, math.pi / 2)
    for _ in range(rng.integers(1, 4)):
        place = (rng.uniform(-28, 28), canvas.either(-1, 1) * rng.uniform(12, 30))
        size_m = (rng.uniform(14, 40), rng.uniform(10, 24))
        kind = canvas.either("metal", "flat", "metal", "village")
        add_building(canvas, place, size_m, 0.0, kind)
    goods = ("container", "container", "pallets", "skip", "painted box", "girders")
    kinds = (*goods, "tarpaulin", "air conditioner", "shed", "bins", "rubble", "kiosk")
    for _ in range(rng.integers(8, 26)):
        place = (rng.uniform(-1, 1) * canvas.reach_m, rng.normal(0, 9))
        if canvas.base_height(place) < 0.5:
            add_clutter(canvas, place, canvas.either(0, math.pi / 2), *kinds)
    for _ in range(rng.integers(0, 4)):
        place = (rng.uniform(-30, 30), rng.uniform(-30, 30))
        if rng.random() < 0.6:
            add_tree(canvas, place, rng.uniform(1.5, 4))
        else:
            add_stand(canvas, place, rng.uniform(3, 8))


def draw_fields(canvas: Canvas) -> None:
    """Draws crops, meadow and soil divided by a track with bushes along it."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=rng.uniform(0, 2.5))
    track_v = rng.uniform(-15, 15)
    (lay_grass if rng.random() < 0.6 else lay_soil)(canvas, ground)
    for side in (-1, 1):
        if rng.random() < 0.6:
            coverage = np.clip(0.5 + (side * (ground.v - track_v) - 3) / 0.5, 0, 1)
            half = dataclasses.replace(ground, coverage=coverage.astype(np.float32))
            (lay_soil if rng.random() < 0.5 else lay_grass)(canvas, half)
            deep = rng.uniform(0.05, 0.3)
            rows = deep * np.sin(2 * math.pi * ground.v / rng.uniform(0.5, 1.6))
            canvas.shade(half, 1 + rows * np.clip(1 + 0.5 * canvas.noise("patch", ground), 0, 1.5))
    width_m = rng.uniform(2.6, 5)
    draw = rng.random()
    if draw < 0.35:
        add_road(canvas, ground, track_v, width_m, kerbed=False)
    elif draw < 0.85:
        soil = canvas.pick(SOIL)
        canvas.allow(canvas.band(ground, track_v, 0.4))
        for v_m in (-0.9, 0.9):
            rut = canvas.band(ground, track_v + v_m, 0.9, 0.15)
            canvas.paint(rut, canvas.varied(rut, soil, 0.3, 2, grain=0.1, mottle=0.1))
    for _ in range(rng.integers(3, 22)):
        if rng.random() < 0.6:
            v_m = track_v + canvas.either(-1, 1) * rng.uniform(3.5, 6)
        else:
            v_m = rng.uniform(-35, 35)
        place = (rng.uniform(-1, 1) * canvas.reach_m, v_m)
        if rng.random() < 0.55:
            add_bush(canvas, place, rng.uniform(0.5, 2.2))
        else:
            add_tree(canvas, place, rng.uniform(1.5, 5))
    for _ in range(rng.integers(0, 5)):
        place = (rng.uniform(-30, 30), track_v + rng.uniform(-12, 12))
        add_clutter(canvas, place, 0.0, "tarpaulin", "shed", "pallets", "container", "skip")


def draw_village(canvas: Canvas) -> None:
    """Draws houses with sheet roofs at all angles on bare soil, as in fast-growing towns."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=rng.uniform(0.5, 3))
    lay_soil(canvas, ground)
    centre_v = rng.uniform(-12, 12)
    width_m = rng.uniform(3.5, 6)
    road = canvas.band(ground, centre_v, width_m, 0.3)
    (lay_soil if rng.random() < 0.7 else lay_asphalt)(canvas, road)
    allow_lanes(canvas, road, width_m, kerbed=False)
    grid_m = np.arange(-canvas.reach_m, canvas.reach_m, 13.0).tolist()
    for u_m, v_m in ((u_m, v_m) for u_m in grid_m for v_m in grid_m):
        place = (u_m + rng.uniform(-3, 3), v_m + rng.uniform(-3, 3))
        column, row = np.clip(canvas.to_pixels(*place), 0, canvas.pixels - 1).astype(int)
        if road.inside[row, column] > -4:
            continue
        angle_rad = rng.normal(0, 0.12) + canvas.either(0, math.pi / 2)
        draw = rng.random()
        if draw < 0.72:
            size_m = (rng.uniform(6, 13), rng.uniform(4, 9))
            kind = canvas.either("village", "village", "tiled", "metal")
            add_building(canvas, place, size_m, angle_rad, kind)
        elif draw < 0.85:
            kinds = ("shed", "tarpaulin", "bins", "pallets", "painted box", "rubble", "kiosk")
            add_clutter(canvas, place, angle_rad, *kinds)
        for _ in range(rng.integers(0, 3)):
            spot = (place[0] + rng.uniform(-7, 7), place[1] + rng.uniform(-7, 7))
            (add_tree if rng.random() < 0.6 else add_bush)(canvas, spot, rng.uniform(0.8, 3.0))


def draw_park(canvas: Canvas) -> None:
    """Draws lawns, paths, woods and a painted court."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=rng.uniform(1, 5))
    lay_grass(canvas, ground)
    for centre_v in (rng.uniform(-20, 0), rng.uniform(0, 20)):
        path = canvas.band(ground, centre_v, rng.uniform(1.5, 3.5), 0.1)
        (lay_soil if rng.random() < 0.5 else lay_asphalt)(canvas, path)
    if rng.random() < 0.5:
        place = (rng.uniform(-15, 15), rng.uniform(-15, 15))
        canvas.paint(canvas.rectangle(place, (24.0, 13.0)), canvas.pick(_COURTS))
        for inset_m in (1.0, 2.4):
            line = canvas.rectangle(place, (24 - 2 * inset_m, 13 - 2 * inset_m))
            painted = (np.abs(line.inside) < 0.08).astype(np.float32)
            canvas.paint(line, reflectance((226, 226, 220)), painted * 0.9)
    woods = rng.uniform(0.2, 1.6)
    for _ in range(rng.integers(10, 50)):
        place = (rng.uniform(-1, 1) * canvas.reach_m, rng.uniform(-1, 1) * canvas.reach_m)
        if canvas.noise("patch").flat[0] < woods:
            (add_tree if rng.random() < 0.7 else add_bush)(canvas, place, rng.uniform(1.0, 4))
    for _ in range(rng.integers(0, 3)):
        place = (rng.uniform(-30, 30), rng.uniform(-30, 30))
        add_stand(canvas, place, rng.uniform(4, 12))
    kinds = ("bench", "bench", "bins", "shed", "tarpaulin", "painted box", "kiosk")
    for _ in range(rng.integers(2, 9)):
        place = (rng.uniform(-25, 25), rng.uniform(-25, 25))
        add_clutter(canvas, place, rng.uniform(0, math.pi), *kinds)


GROUND_KINDS: dict[str, tuple[Callable[[Canvas], None], float]] = {
    "car park": (draw_car_park, 0.2),
    "crossroads": (draw_crossroads, 0.15),
    "fields": (draw_fields, 0.08),
    "park": (draw_park, 0.08),
    "street": (draw_street, 0.2),
    "village": (draw_village, 0.14),
    "yard": (draw_yard, 0.15),
}
"""The kinds of ground and their shares, larger for kinds with vehicles or things like them."""
