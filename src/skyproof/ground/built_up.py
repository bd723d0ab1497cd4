"""Built-up kinds of the procedural ground: a street, a crossroads, a car park, a yard."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from skyproof.ground.buildings import add_building
from skyproof.ground.canvas import Canvas, Colour, Patch, reflectance
from skyproof.ground.clutter import add_clutter, add_lamp_post
from skyproof.ground.markings import mark_guides
from skyproof.ground.plants import add_bush, add_hedge, add_stand, add_tree
from skyproof.ground.surfaces import (
    CONCRETE,
    PAVING,
    add_pavement,
    add_road,
    add_street_furniture,
    lay_asphalt,
    lay_grass,
    lay_paving,
    lay_soil,
    pick_asphalt,
)


def draw_street(canvas: Canvas) -> None:
    """A residential street: plots with houses, drives, gardens, sheds, hedges, pools."""
    rng = canvas.rng
    ground = canvas.everywhere(wander_m=float(rng.uniform(0, 1.0)))
    lay_grass(canvas, ground)
    width = float(rng.uniform(5, 7.5))
    pavement = float(rng.uniform(1.2, 2.4))
    centre = float(rng.uniform(-10, 10))
    add_pavement(canvas, ground, centre, width, pavement)
    add_road(canvas, ground, centre, width)
    front = width / 2 + pavement
    verge = float(rng.uniform(3, 8))
    roof = str(rng.choice(["tiled", "tiled", "tiled", "metal", "flat"]))
    for side in (-1, 1):
        u_m = -canvas.reach_m
        while u_m < canvas.reach_m:
            plot = float(rng.uniform(12, 20))
            depth = float(rng.uniform(8, 12))
            house_v = centre + side * (front + verge + depth / 2)
            drive_u = u_m + 2.0
            drive = canvas.rectangle(
                (drive_u, centre + side * (front + (verge + depth) / 2)), (3.0, verge + depth)
            )
            if not drive.empty and rng.random() < 0.8:
                lay_paving(canvas, drive, PAVING + CONCRETE + ((150, 90, 74),), 0.4)
                # A vehicle's middle stays half a vehicle from both ends of the drive.
                middle = (drive_u, centre + side * (front + (verge + depth) / 2))
                canvas.allow(canvas.rectangle(middle, (verge + depth - 5, 0.5), math.pi / 2))
            house = (plot - float(rng.uniform(5, 7)), depth)
            wing = float(rng.choice([0, math.pi / 2])) if abs(house[0] - depth) < 3 else 0.0
            own_roof = roof if rng.random() < 0.8 else "tiled"
            add_building(canvas, (u_m + 3.8 + house[0] / 2, house_v), house, wing, own_roof)
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
            if rng.random() < 0.15:
                add_stand(canvas, (u_m + plot / 2, back + side * 4), float(rng.uniform(3, 6)))
            if rng.random() < 0.6:
                add_hedge(canvas, (u_m, house_v + side * 5), depth + 14, math.pi / 2)
            if rng.random() < 0.6:
                add_clutter(
                    canvas,
                    (drive_u, centre + side * (front + verge)),
                    math.pi / 2,
                    ("bins", "painted box", "skip", "tarpaulin"),
                )
            if rng.random() < 0.5:
                add_bush(
                    canvas,
                    (u_m + plot / 2, centre + side * (front + 1.5)),
                    float(rng.uniform(0.5, 1.6)),
                )
            u_m += plot
        if rng.random() < 0.7:
            add_street_furniture(canvas, centre + side * (front + 0.8))


def draw_crossroads(canvas: Canvas) -> None:
    """Two roads that meet, with stop lines, crossings, islands and buildings on the corners."""
    rng = canvas.rng
    ground = canvas.everywhere()
    (lay_grass if rng.random() < 0.5 else lay_paving)(canvas, ground)
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
                add_stand(canvas, place, float(rng.uniform(3, 9)))
    add_pavement(canvas, across, 0.0, widths[1], pavement)
    add_pavement(canvas, ground, 0.0, widths[0], pavement)
    colour = pick_asphalt(canvas)
    add_road(canvas, across, 0.0, widths[1], colour=colour)
    add_road(canvas, ground, 0.0, widths[0], colour=colour)
    first = canvas.band(ground, 0.0, widths[0] + 0.4)
    second = canvas.band(across, 0.0, widths[1] + 0.4)
    lay_asphalt(
        canvas, dataclasses.replace(first, coverage=first.coverage * second.coverage), colour
    )
    for patch, width, other in ((ground, widths[0], widths[1]), (across, widths[1], widths[0])):
        crossing = canvas.band(patch, 0.0, width - 0.6)
        _lay_over_crossing(canvas, crossing, other)
        if rng.random() < 0.6:
            # A path for cycles or for feet runs beside the road, and crosses the other one.
            side = float(rng.choice([-1, 1]))
            crossed = second if patch is ground else first
            mark_guides(canvas, patch, side * (width / 2 + 1.5), crossed)
    for _ in range(int(rng.integers(1, 4))):
        spot = (
            float(rng.choice([-1, 1])) * (widths[1] / 2 + 6),
            float(rng.normal(0, widths[0] / 3)),
        )
        add_clutter(canvas, spot, 0.0, ("painted box", "painted box", "skip", "pallets"))
    for side in (-1, 1):
        add_street_furniture(canvas, side * (widths[0] / 2 + 1.0))


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


def draw_car_park(canvas: Canvas) -> None:
    """Rows of painted bays with aisles, planted islands, and what stands about in car parks."""
    rng = canvas.rng
    ground = canvas.everywhere()
    lay_asphalt(canvas, ground)
    bay_m = float(rng.uniform(2.3, 2.7))
    length_m = float(rng.uniform(4.6, 5.4))
    aisle_m = float(rng.uniform(5.5, 7.5))
    period = 2 * length_m + aisle_m
    offset = float(rng.uniform(0, 15))
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
    in_bay = np.abs(np.mod(u + bay_m / 2, bay_m) - bay_m / 2) < 0.3
    for row in range(int(-canvas.reach_m // period) - 1, int(canvas.reach_m // period) + 2):
        spine_v = row * period + length_m - offset
        planted = rng.random() < 0.4
        if planted:
            strip = canvas.band(ground, spine_v, 1.6)
            canvas.paint(canvas.band(ground, spine_v, 1.9), reflectance((176, 172, 164)))
            lay_grass(canvas, strip)
        # Vehicles park in the middle of the bays, off what is planted, and drive along the aisles.
        for half in (-1, 1):
            bays = ground.v - spine_v - half * (length_m / 2 + (0.5 if planted else 0.0))
            canvas.allow(ground, in_bay & (np.abs(bays) < 0.3), math.pi / 2 + math.atan(slant))
        canvas.allow(ground, np.abs(ground.v - spine_v - period / 2) < 0.06)
        for u_m in np.arange(-canvas.reach_m, canvas.reach_m, bay_m):
            bay = (float(u_m), spine_v + float(rng.choice([-1, 1])) * length_m / 2)
            draw = rng.random()
            if draw < 0.07:
                add_clutter(
                    canvas,
                    bay,
                    math.pi / 2,
                    ("painted box", "skip", "tarpaulin", "pallets", "container", "bins"),
                )
            elif draw < 0.13:
                canvas.shade(
                    canvas.rectangle(bay, (bay_m - 0.3, length_m - 0.6), 0.0, 0.5),
                    float(rng.uniform(0.8, 0.93)),
                )
            elif draw < 0.18 and planted:
                add_tree(canvas, (float(u_m), spine_v), float(rng.uniform(1.2, 3.2)))
            elif draw < 0.20:
                add_lamp_post(canvas, (float(u_m), spine_v))
    if rng.random() < 0.6:
        size = (float(rng.uniform(20, 60)), float(rng.uniform(12, 25)))
        side = float(rng.choice([-1, 1])) * float(rng.uniform(20, 32))
        forecourt = canvas.rectangle((0.0, side), (size[0] + 8, size[1] + 8))
        lay_paving(canvas, forecourt)
        canvas.forbid(forecourt)
        add_building(
            canvas,
            (float(rng.uniform(-10, 10)), side),
            size,
            0.0,
            str(rng.choice(["flat", "metal"])),
        )


def draw_yard(canvas: Canvas) -> None:
    """An industrial yard: halls, a concrete or gravel ground, containers, pallets, skips."""
    rng = canvas.rng
    ground = canvas.everywhere()
    draw = rng.random()
    if draw < 0.45:
        lay_paving(canvas, ground, CONCRETE, float(rng.uniform(3, 6)))
    elif draw < 0.8:
        lay_asphalt(canvas, ground)
    else:
        lay_soil(canvas, ground)
    # Vehicles stand along the halls in some rows and across in others.
    along = np.mod(ground.v, 16.0) < 8.0
    canvas.allow(ground, along)
    canvas.allow(ground, ~along, math.pi / 2)
    for _ in range(int(rng.integers(1, 4))):
        place = (
            float(rng.uniform(-28, 28)),
            float(rng.choice([-1, 1])) * float(rng.uniform(12, 30)),
        )
        size = (float(rng.uniform(14, 40)), float(rng.uniform(10, 24)))
        add_building(
            canvas, place, size, 0.0, str(rng.choice(["metal", "flat", "metal", "village"]))
        )
    kinds = (
        "container",
        "container",
        "pallets",
        "skip",
        "painted box",
        "tarpaulin",
        "air conditioner",
        "shed",
        "bins",
    )
    for _ in range(int(rng.integers(8, 26))):
        place = (float(rng.uniform(-1, 1)) * canvas.reach_m, float(rng.normal(0, 9)))
        if canvas.base_height(place) < 0.5:
            add_clutter(canvas, place, float(rng.choice([0, math.pi / 2])), kinds)
    for _ in range(int(rng.integers(0, 4))):
        place = (float(rng.uniform(-30, 30)), float(rng.uniform(-30, 30)))
        if rng.random() < 0.6:
            add_tree(canvas, place, float(rng.uniform(1.5, 4)))
        else:
            add_stand(canvas, place, float(rng.uniform(3, 8)))
