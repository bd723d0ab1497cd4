"""What lies flat on the procedural ground: asphalt, paving, grass, soil, and the roads of them."""

from __future__ import annotations

import math

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Colour, Patch, pick
from skyproof.ground.clutter import add_lamp_post, add_manhole
from skyproof.ground.markings import mark_arrow, mark_bays, mark_lanes
from skyproof.ground.plants import add_tree

ASPHALT: tuple[Colour, ...] = (
    (108, 108, 110),
    (92, 92, 95),
    (124, 122, 120),
    (72, 73, 76),
    (148, 145, 140),
)
PAVING: tuple[Colour, ...] = ((160, 156, 148), (148, 142, 136), (172, 164, 150), (134, 132, 132))
GRASS: tuple[Colour, ...] = (
    (96, 112, 62),
    (84, 104, 58),
    (120, 124, 74),
    (138, 132, 88),
    (76, 98, 52),
)
SOIL: tuple[Colour, ...] = (
    (150, 124, 96),
    (134, 108, 84),
    (170, 146, 116),
    (152, 104, 80),
    (120, 98, 80),
)
TWO_LANES_M = 5.0
PARKED_ALONG_M = 6.0
"""From this width of a road on vehicles drive both ways, and others park along its kerbs."""
CONCRETE: tuple[Colour, ...] = ((168, 166, 160), (150, 148, 144), (180, 176, 166))


def pick_asphalt(canvas: Canvas) -> Array:
    """A reflectance of asphalt."""
    return pick(canvas, ASPHALT)


def lay_asphalt(canvas: Canvas, patch: Patch, colour: Array | None = None) -> None:
    """Asphalt with wear, patches of other age, cracks and oil."""
    rng = canvas.rng
    colour = pick_asphalt(canvas) if colour is None else colour
    uneven = float(rng.uniform(0.06, 0.16))
    wear = (
        1
        + 0.05 * canvas.noise("grain", patch)
        + 0.06 * canvas.noise("mottle", patch)
        + uneven * canvas.noise("patch", patch)
    )
    canvas.paint(patch, colour * np.clip(wear, 0.5, 1.6)[..., None])
    crack = (
        np.abs(
            canvas.noise("patch", patch) + 0.15 * canvas.noise("mottle", patch) - rng.uniform(-1, 1)
        )
        < 0.025
    )
    canvas.shade(patch, np.where(crack, rng.uniform(0.7, 0.95), 1.0).astype(np.float32))
    reach = canvas.reach_m * 0.8
    for _ in range(int(rng.poisson(5))):
        place = (float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach)))
        size = (float(rng.uniform(1, 9)), float(rng.uniform(0.6, 3)))
        repair = canvas.rectangle(place, size, float(rng.choice([0, math.pi / 2])))
        _within(canvas, repair, patch, float(rng.uniform(0.75, 1.2)))
    for _ in range(int(rng.poisson(6))):
        place = (float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach)))
        _within(
            canvas,
            canvas.disc(place, float(rng.uniform(0.3, 1.6)), 0.3),
            patch,
            float(rng.uniform(0.65, 0.9)),
        )
    for _ in range(int(rng.poisson(10))):
        _stain(canvas, patch)


def _stain(canvas: Canvas, ground: Patch) -> None:
    """Darkens a place of a vehicle's size that has no edge, as braking and dripping leave it."""
    rng = canvas.rng
    reach = canvas.reach_m * 0.8
    length_m, width_m = float(rng.uniform(1.5, 8)), float(rng.uniform(0.8, 3.5))
    place = (float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach)))
    angle_rad = float(rng.choice([0, math.pi / 2])) + float(rng.normal(0, 0.2))
    stain = canvas.rectangle(place, (2 * length_m, 2 * width_m), angle_rad)
    if not stain.empty:
        fading = np.exp(-2.5 * ((stain.u / length_m) ** 2 + (stain.v / width_m) ** 2))
        _within(canvas, stain, ground, 1 - float(rng.uniform(0.05, 0.4)) * fading)


def _within(canvas: Canvas, spot: Patch, ground: Patch, factor: float | Array) -> None:
    """Shades a spot only where `ground` (a whole-canvas patch) lies."""
    if not spot.empty:
        canvas.shade(spot, 1 + (factor - 1) * ground.coverage[spot.rows, spot.columns])


def lay_grass(canvas: Canvas, patch: Patch) -> None:
    """Grass of two tones with bare and mown places."""
    blend = np.clip(
        0.5 + 0.5 * canvas.noise("patch", patch) + 0.25 * canvas.noise("mottle", patch), 0, 1
    )[..., None]
    colour = pick(canvas, GRASS) * blend + pick(canvas, GRASS) * (1 - blend)
    bare = np.clip(
        canvas.noise("patch", patch) + 0.4 * canvas.noise("mottle", patch) - 1.3, 0, 0.8
    )[..., None]
    colour = colour + bare * (pick(canvas, SOIL) - colour)
    texture = 1 + 0.10 * canvas.noise("grain", patch) + 0.08 * canvas.noise("clump", patch)
    canvas.paint(patch, (colour * np.clip(texture, 0.3, 2)[..., None]).astype(np.float32))


def lay_soil(canvas: Canvas, patch: Patch) -> None:
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
    weeds = np.clip(
        0.6 * canvas.noise("mottle", patch) + 0.5 * canvas.noise("patch", patch) - 0.9, 0, 1
    )[..., None]
    canvas.paint(patch, (colour + weeds * (pick(canvas, GRASS) - colour)).astype(np.float32))


def lay_paving(
    canvas: Canvas, patch: Patch, colours: tuple[Colour, ...] = PAVING, slab_m: float = 0.6
) -> None:
    """Slabs with joints; large ones make a concrete yard."""
    joints = (np.mod(patch.u, slab_m) < 0.06 + 0.01 * slab_m) | (
        np.mod(patch.v, slab_m) < 0.06 + 0.01 * slab_m
    )
    texture = (
        1
        + 0.04 * canvas.noise("grain", patch)
        + 0.07 * canvas.noise("mottle", patch)
        + 0.05 * canvas.noise("patch", patch)
    )
    texture = np.clip(texture, 0.4, 2) * np.where(joints, 0.85, 1.0)
    canvas.paint(patch, (pick(canvas, colours) * texture[..., None]).astype(np.float32))


def add_pavement(
    canvas: Canvas, ground: Patch, centre_v_m: float, road_m: float, pavement_m: float
) -> None:
    """Pavements on both sides of a road still to be laid, with its kerbs."""
    lay_paving(canvas, canvas.band(ground, centre_v_m, road_m + 2 * pavement_m))
    canvas.paint(
        canvas.band(ground, centre_v_m, road_m + 0.3),
        pick(canvas, ((186, 182, 174), (160, 158, 154))),
    )


def add_road(
    canvas: Canvas,
    ground: Patch,
    centre_v_m: float,
    width_m: float,
    *,
    colour: Array | None = None,
    kerbed: bool = True,
) -> None:
    """A road along u with wheel tracks, lane lines and covers; without kerbs its edge is ragged."""
    rng = canvas.rng
    road = canvas.band(ground, centre_v_m, width_m, 0.0 if kerbed else 0.15)
    lay_asphalt(canvas, road, colour)
    # Wheels polish two tracks of each lane, and oil drips between them.
    deep = float(rng.uniform(0.02, 0.1))
    wheel_tracks = 1 - deep * np.cos(2 * math.pi * road.v / 1.75) * (np.abs(road.v) < width_m / 2)
    canvas.shade(road, wheel_tracks.astype(np.float32))
    lanes = max(2, round(width_m / 3.4))
    allow_lanes(canvas, road, width_m, kerbed=kerbed)
    mark_lanes(canvas, road, width_m, lanes)
    if kerbed and width_m >= PARKED_ALONG_M and rng.random() < 0.3:
        mark_bays(canvas, road, width_m)
    for _ in range(int(rng.poisson(1.0)) if kerbed else 0):
        v_m = centre_v_m + ((int(rng.integers(lanes)) + 0.5) / lanes - 0.5) * width_m
        turn = float(rng.choice([0, math.pi]))
        mark_arrow(canvas, (float(rng.uniform(-1, 1)) * canvas.reach_m, v_m), turn)
    for _ in range(int(rng.integers(1, 6))):
        add_manhole(
            canvas,
            (
                float(rng.uniform(-1, 1)) * canvas.reach_m,
                centre_v_m + float(rng.uniform(-0.4, 0.4)) * width_m,
            ),
        )


def allow_lanes(canvas: Canvas, road: Patch, width_m: float, *, kerbed: bool) -> None:
    """Lets vehicles drive in the middle of each lane of a road, and park along its kerbs."""
    lanes = max(2, round(width_m / 3.4)) if width_m >= TWO_LANES_M else 1
    for lane in range(lanes):
        canvas.allow(canvas.band(road, ((lane + 0.5) / lanes - 0.5) * width_m, 0.5))
    if kerbed and width_m >= PARKED_ALONG_M:
        for side in (-1, 1):
            canvas.allow(canvas.band(road, side * (width_m / 2 - 1.1), 0.3))


def add_street_furniture(canvas: Canvas, v_m: float) -> None:
    """Lamp posts and street trees in a row along u."""
    rng = canvas.rng
    spacing = float(rng.uniform(9, 22))
    start = float(rng.uniform(0, 9))
    trees = rng.random() < 0.6
    for u_m in np.arange(-canvas.reach_m + start, canvas.reach_m, spacing):
        if trees and rng.random() < 0.7:
            add_tree(canvas, (float(u_m), v_m), float(rng.uniform(1.2, 3.6)))
        elif rng.random() < 0.5:
            add_lamp_post(canvas, (float(u_m), v_m))
