"""Open kinds of the procedural ground: fields, a village, a park."""

import dataclasses
import math

import numpy as np

from skyproof.ground.buildings import add_building
from skyproof.ground.canvas import Canvas, palette, reflectance
from skyproof.ground.clutter import add_bush, add_clutter, add_stand, add_tree
from skyproof.ground.surfaces import SOIL, add_road, allow_lanes, lay_asphalt, lay_grass, lay_soil

_COURTS = palette("783c32 325a50 3c5078 787878")


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
            kinds = ("shed", "tarpaulin", "bins", "pallets", "painted box")
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
        canvas.paint_rectangle(place, (24.0, 13.0), 0.0, canvas.pick(_COURTS))
        for inset_m in (1.0, 2.4):
            line = canvas.rectangle(place, (24 - 2 * inset_m, 13 - 2 * inset_m))
            painted = (np.abs(line.inside) < 0.08).astype(np.float32)
            canvas.paint(line, reflectance((226, 226, 220)), painted * 0.9)
    woods = rng.uniform(0.2, 1.6)
    for _ in range(rng.integers(10, 50)):
        place = (rng.uniform(-1, 1) * canvas.reach_m, rng.uniform(-1, 1) * canvas.reach_m)
        if canvas.noise("patch").flat[0] < woods:
            add_tree(canvas, place, rng.uniform(1.2, 5))
    for _ in range(rng.integers(0, 3)):
        place = (rng.uniform(-30, 30), rng.uniform(-30, 30))
        add_stand(canvas, place, rng.uniform(4, 12))
    kinds = ("bench", "bench", "bins", "shed", "tarpaulin", "painted box")
    for _ in range(rng.integers(2, 9)):
        place = (rng.uniform(-25, 25), rng.uniform(-25, 25))
        add_clutter(canvas, place, rng.uniform(0, math.pi), *kinds)
