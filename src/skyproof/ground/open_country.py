"""Open kinds of the procedural ground: fields, a village, a park."""

from __future__ import annotations

import math

import numpy as np

from skyproof.ground.buildings import add_building
from skyproof.ground.canvas import Array, Canvas, Patch, pick, reflectance
from skyproof.ground.clutter import add_clutter
from skyproof.ground.plants import add_bush, add_stand, add_tree
from skyproof.ground.surfaces import (
    SOIL,
    add_road,
    allow_lanes,
    lay_asphalt,
    lay_grass,
    lay_soil,
)


def draw_fields(canvas: Canvas) -> None:
    """Crops, meadow and soil divided by a track with bushes along it."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0, 2.5)))
    track_v = float(rng.uniform(-15, 15))
    (lay_grass if rng.random() < 0.6 else lay_soil)(canvas, ground)
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
            (lay_soil if rng.random() < 0.5 else lay_grass)(canvas, half)
            rows = 1 + rng.uniform(0.05, 0.3) * np.sin(
                2 * math.pi * ground.v / rng.uniform(0.5, 1.6)
            ) * np.clip(1 + 0.5 * canvas.noise("patch", ground), 0, 1.5)
            canvas.shade(half, rows.astype(np.float32))
    width = float(rng.uniform(2.6, 5))
    draw = rng.random()
    if draw < 0.35:
        add_road(canvas, ground, track_v, width, kerbed=False)
    elif draw < 0.85:
        tracks: Array = pick(canvas, SOIL)
        canvas.allow(canvas.band(ground, track_v, 0.4))
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


def draw_village(canvas: Canvas) -> None:
    """Houses with sheet roofs at all angles on bare soil, as in fast-growing towns."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0.5, 3)))
    lay_soil(canvas, ground)
    centre = float(rng.uniform(-12, 12))
    width = float(rng.uniform(3.5, 6))
    road = canvas.band(ground, centre, width, 0.3)
    (lay_soil if rng.random() < 0.7 else lay_asphalt)(canvas, road)
    allow_lanes(canvas, road, width, kerbed=False)
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
                add_building(
                    canvas,
                    place,
                    size,
                    angle,
                    str(rng.choice(["village", "village", "tiled", "metal"])),
                )
            elif draw < 0.85:
                add_clutter(
                    canvas, place, angle, ("shed", "tarpaulin", "bins", "pallets", "painted box")
                )
            for _ in range(int(rng.integers(0, 3))):
                spot = (place[0] + float(rng.uniform(-7, 7)), place[1] + float(rng.uniform(-7, 7)))
                (add_tree if rng.random() < 0.6 else add_bush)(
                    canvas, spot, float(rng.uniform(0.8, 3.0))
                )


def draw_park(canvas: Canvas) -> None:
    """Lawns, paths, woods, a painted court."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(1, 5)))
    lay_grass(canvas, ground)
    for centre in (float(rng.uniform(-20, 0)), float(rng.uniform(0, 20))):
        path = canvas.band(ground, centre, float(rng.uniform(1.5, 3.5)), 0.1)
        (lay_soil if rng.random() < 0.5 else lay_asphalt)(canvas, path)
    if rng.random() < 0.5:
        place = (float(rng.uniform(-15, 15)), float(rng.uniform(-15, 15)))
        court = canvas.rectangle(place, (24.0, 13.0))
        canvas.paint(
            court, pick(canvas, ((120, 60, 50), (50, 90, 80), (60, 80, 120), (120, 120, 120)))
        )
        for inset in (1.0, 2.4):
            line = canvas.rectangle(place, (24 - 2 * inset, 13 - 2 * inset))
            if not line.empty:
                canvas.paint(
                    line,
                    reflectance((226, 226, 220)),
                    (np.abs(line.inside) < 0.08).astype(np.float32) * 0.9,
                )
    woods = float(rng.uniform(0.2, 1.6))
    for _ in range(int(rng.integers(10, 50))):
        place = (
            float(rng.uniform(-1, 1)) * canvas.reach_m,
            float(rng.uniform(-1, 1)) * canvas.reach_m,
        )
        if canvas.noise("patch").flat[0] < woods:
            add_tree(canvas, place, float(rng.uniform(1.2, 5)))
    for _ in range(int(rng.integers(0, 3))):
        place = (float(rng.uniform(-30, 30)), float(rng.uniform(-30, 30)))
        add_stand(canvas, place, float(rng.uniform(4, 12)))
    for _ in range(int(rng.integers(2, 9))):
        place = (float(rng.uniform(-25, 25)), float(rng.uniform(-25, 25)))
        add_clutter(
            canvas,
            place,
            float(rng.uniform(0, math.pi)),
            ("bench", "bench", "bins", "shed", "tarpaulin", "painted box"),
        )
