"""Flat ground of the procedural tiles: road paint, asphalt, paving, grass, soil, and roads."""

import math

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Colour, Patch, Place, beside, palette
from skyproof.ground.clutter import add_lamp_post, add_manhole, add_tree

_WHITE = (228, 226, 218)
_YELLOW = (226, 206, 116)


def mark(canvas: Canvas, patch: Patch, where: float | Array = 1.0) -> None:
    """Lays road paint on the share `where` of a patch, white and worn in places."""
    if not patch.empty:
        kept = canvas.rng.uniform(0.55, 0.95) + 0.22 * canvas.noise("mottle", patch)
        colour = _YELLOW if canvas.rng.random() < 0.08 else _WHITE
        canvas.paint(patch, canvas.pick((colour,), 0.06), np.clip(kept, 0.1, 1) * where)


def mark_lanes(canvas: Canvas, road: Patch, width_m: float, lanes: int) -> None:
    """Marks lines between the lanes of a road along u, dashed, solid or none, and at its edges."""
    rng = canvas.rng
    style = rng.choice(["none", "dashed", "solid"], p=[0.15, 0.65, 0.2])
    dashes_m = _dashes(rng)
    for lane in range(1, lanes):
        line = canvas.band(road, (lane / lanes - 0.5) * width_m, rng.uniform(0.12, 0.15))
        if style != "none":
            mark(canvas, line, _dashed(line, *dashes_m) if style == "dashed" else 1.0)
    if rng.random() < 0.45:
        # Some edge lines are those of cycle lanes, and some are dashed.
        inset_m = 0.35 if rng.random() < 0.6 else rng.uniform(1.5, 2.4)
        dashes_m = _dashes(rng) if rng.random() < 0.4 else (1.0, 0.0)
        for side in (-1, 1):
            line = canvas.band(road, side * (width_m / 2 - inset_m), 0.12)
            mark(canvas, line, _dashed(line, *dashes_m))


def mark_guides(canvas: Canvas, place: Place, angle_rad: float, crossed: Patch) -> None:
    """Marks one or two dashed or dotted lines through a place, as far as `crossed` reaches."""
    rng = canvas.rng
    width_m, dot_m = canvas.either(0.12, 0.15, 0.25, 0.4), rng.uniform(0.3, 0.5)
    apart_m = width_m + rng.uniform(0.4, canvas.either(0.6, 2.5, 4.0))
    dashes_m = (dot_m, dot_m) if width_m > 0.2 or rng.random() < 0.4 else _dashes(rng)
    for side in canvas.either((-1, 1), (-1, 1), (0,)):
        middle = beside(place, angle_rad, 0.0, side * apart_m / 2)
        line = canvas.rectangle(middle, (30.0, width_m), angle_rad)
        mark(canvas, line, _dashed(line, *dashes_m) * crossed.coverage[line.rows, line.columns])


def mark_bays(canvas: Canvas, road: Patch, width_m: float) -> None:
    """Marks parking bays along one kerb of a road, sometimes with only the corners of the edge."""
    rng = canvas.rng
    side = canvas.either(-1, 1)
    deep_m = rng.uniform(1.9, 2.4)
    length_m = rng.uniform(5.2, 6.5)
    bays = canvas.band(road, side * (width_m - deep_m) / 2, deep_m)
    along = np.mod(bays.u + rng.uniform(0, length_m), length_m)
    edge = (bays.inside < 0.14) & (side * bays.v < 0)
    if rng.random() < 0.5:
        # Corners alone, as a T.
        edge &= (along < 0.6) | (along > length_m - 0.5)
    mark(canvas, bays, ((along < 0.14) | edge).astype(np.float32))


def mark_arrow(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Marks an arrow as long as a small car, in the middle of a lane."""
    length_m = canvas.rng.uniform(2.5, 5.0)
    mark(canvas, canvas.rectangle(place, (length_m, 0.16), angle_rad))
    head = canvas.rectangle(beside(place, angle_rad, length_m / 2, 0.0), (1.4, 0.9), angle_rad)
    mark(canvas, head, (np.abs(head.v) < 0.45 * (0.7 - head.u) / 1.4).astype(np.float32))


def _dashes(rng: np.random.Generator) -> tuple[float, float]:
    """Draws the lengths of a line's dashes and gaps; half are those of usual lane lines."""
    if rng.random() < 0.5:
        return 3.0, rng.uniform(3.0, 6.0)
    dash_m = math.exp(rng.uniform(math.log(0.5), math.log(6.0)))
    return dash_m, dash_m * rng.uniform(0.6, 2.2)


def _dashed(line: Patch, dash_m: float, gap_m: float) -> Array:
    return (np.mod(line.u, dash_m + gap_m) < dash_m).astype(np.float32)


ASPHALT = palette("6c6c6e 5c5c5f 7c7a78 48494c 94918c")
PAVING = palette("a09c94 948e88 aca496 868484")
GRASS = palette("60703e 54683a 787c4a 8a8458 4c6234")
SOIL = palette("967c60 866c54 aa9274 986850 786250")
CONCRETE = palette("a8a6a0 969490 b4b0a6")
_KERBS = palette("bab6ae a09e9a")
TWO_LANES_M = 5.0
"""Vehicles drive both ways on a road at least this wide."""
PARKED_ALONG_M = 6.0
"""Vehicles park along the kerbs of a road at least this wide."""


def lay_asphalt(canvas: Canvas, patch: Patch, colour: Array | None = None) -> None:
    """Lays asphalt with wear, patches of other age, cracks and oil."""
    rng = canvas.rng
    colour = canvas.pick(ASPHALT) if colour is None else colour
    uneven = rng.uniform(0.06, 0.16)
    wear = canvas.varied(patch, colour, 0.5, 1.6, grain=0.05, mottle=0.06, patch=uneven)
    canvas.paint(patch, wear)
    veins = canvas.noise("patch", patch) + 0.15 * canvas.noise("mottle", patch)
    cracked = np.abs(veins - rng.uniform(-1, 1)) < 0.025
    canvas.shade(patch, np.where(cracked, rng.uniform(0.7, 0.95), 1.0))
    reach_m = canvas.reach_m * 0.8
    for _ in range(rng.poisson(5)):
        place = (rng.uniform(-reach_m, reach_m), rng.uniform(-reach_m, reach_m))
        size_m = (rng.uniform(1, 9), rng.uniform(0.6, 3))
        repair = canvas.rectangle(place, size_m, canvas.either(0, math.pi / 2))
        _shade_within(canvas, repair, patch, rng.uniform(0.75, 1.2))
    for _ in range(rng.poisson(6)):
        place = (rng.uniform(-reach_m, reach_m), rng.uniform(-reach_m, reach_m))
        oil = canvas.disc(place, rng.uniform(0.3, 1.6), 0.3)
        _shade_within(canvas, oil, patch, rng.uniform(0.65, 0.9))
    for _ in range(rng.poisson(10)):
        _stain(canvas, patch)


def _stain(canvas: Canvas, ground: Patch) -> None:
    """Darkens a place of a vehicle's size that has no edge, as braking and dripping leave it."""
    rng = canvas.rng
    reach_m = canvas.reach_m * 0.8
    length_m, width_m = rng.uniform(1.5, 8), rng.uniform(0.8, 3.5)
    place = (rng.uniform(-reach_m, reach_m), rng.uniform(-reach_m, reach_m))
    angle_rad = canvas.either(0, math.pi / 2) + rng.normal(0, 0.2)
    stain = canvas.rectangle(place, (2 * length_m, 2 * width_m), angle_rad)
    if not stain.empty:
        fading = np.exp(-2.5 * ((stain.u / length_m) ** 2 + (stain.v / width_m) ** 2))
        _shade_within(canvas, stain, ground, 1 - rng.uniform(0.05, 0.4) * fading)


def _shade_within(canvas: Canvas, spot: Patch, ground: Patch, factor: float | Array) -> None:
    """Shades a spot only where `ground` (a whole-canvas patch) lies."""
    canvas.shade(spot, 1 + (factor - 1) * ground.coverage[spot.rows, spot.columns])


def lay_grass(canvas: Canvas, patch: Patch) -> None:
    """Lays grass of two tones with bare and mown places."""
    tones = 0.5 + 0.5 * canvas.noise("patch", patch) + 0.25 * canvas.noise("mottle", patch)
    blend = np.clip(tones, 0, 1)[..., None]
    colour = canvas.pick(GRASS) * blend + canvas.pick(GRASS) * (1 - blend)
    worn = canvas.noise("patch", patch) + 0.4 * canvas.noise("mottle", patch) - 1.3
    bare = np.clip(worn, 0, 0.8)[..., None]
    colour = colour + bare * (canvas.pick(SOIL) - colour)
    canvas.paint(patch, canvas.varied(patch, colour, 0.3, 2, grain=0.10, clump=0.08))


def lay_soil(canvas: Canvas, patch: Patch) -> None:
    """Lays bare soil or gravel, weeds in places."""
    colour = canvas.varied(patch, canvas.pick(SOIL), 0.4, 2, grain=0.07, mottle=0.10, patch=0.1)
    grown = 0.6 * canvas.noise("mottle", patch) + 0.5 * canvas.noise("patch", patch) - 0.9
    weeds = np.clip(grown, 0, 1)[..., None]
    canvas.paint(patch, colour + weeds * (canvas.pick(GRASS) - colour))


def lay_paving(
    canvas: Canvas, patch: Patch, colours: tuple[Colour, ...] = PAVING, slab_m: float = 0.6
) -> None:
    """Lays slabs with joints; large ones make a concrete yard."""
    joint_m = 0.06 + 0.01 * slab_m
    joints = (np.mod(patch.u, slab_m) < joint_m) | (np.mod(patch.v, slab_m) < joint_m)
    even = np.ones(3, np.float32)
    texture = canvas.varied(patch, even, 0.4, 2, grain=0.04, mottle=0.07, patch=0.05)
    texture = texture * np.where(joints, 0.85, 1.0)[..., None]
    canvas.paint(patch, (canvas.pick(colours) * texture).astype(np.float32))


def add_pavement(
    canvas: Canvas, ground: Patch, centre_v_m: float, road_m: float, pavement_m: float
) -> None:
    """Adds pavements and kerbs on both sides of a road, which is laid afterwards."""
    lay_paving(canvas, canvas.band(ground, centre_v_m, road_m + 2 * pavement_m))
    canvas.paint(canvas.band(ground, centre_v_m, road_m + 0.3), canvas.pick(_KERBS))


def add_road(
    canvas: Canvas,
    ground: Patch,
    centre_v_m: float,
    width_m: float,
    *,
    colour: Array | None = None,
    kerbed: bool = True,
) -> None:
    """Adds a road along u with wheel tracks, lane lines and manholes, ragged if not kerbed."""
    rng = canvas.rng
    road = canvas.band(ground, centre_v_m, width_m, 0.0 if kerbed else 0.15)
    lay_asphalt(canvas, road, colour)
    # Wheels polish two tracks of each lane, and oil drips between them.
    deep = rng.uniform(0.02, 0.1)
    polished = deep * np.cos(2 * math.pi * road.v / 1.75) * (np.abs(road.v) < width_m / 2)
    canvas.shade(road, 1 - polished)
    lanes = max(2, round(width_m / 3.4))
    allow_lanes(canvas, road, width_m, kerbed=kerbed)
    mark_lanes(canvas, road, width_m, lanes)
    if kerbed and width_m >= PARKED_ALONG_M and rng.random() < 0.3:
        mark_bays(canvas, road, width_m)
    if kerbed and rng.random() < 0.4:
        place = (rng.uniform(-0.5, 0.5) * canvas.reach_m, centre_v_m)
        mark_guides(canvas, place, rng.uniform(0.4, 2.7), road)
    for _ in range(rng.poisson(1.0) if kerbed else 0):
        v_m = centre_v_m + ((rng.integers(lanes) + 0.5) / lanes - 0.5) * width_m
        turn_rad = canvas.either(0, math.pi)
        mark_arrow(canvas, (rng.uniform(-1, 1) * canvas.reach_m, v_m), turn_rad)
    for _ in range(rng.integers(1, 6)):
        u_m = rng.uniform(-1, 1) * canvas.reach_m
        add_manhole(canvas, (u_m, centre_v_m + rng.uniform(-0.4, 0.4) * width_m))


def allow_lanes(canvas: Canvas, road: Patch, width_m: float, *, kerbed: bool) -> None:
    """Lets vehicles drive in the middle of each lane of a road, and park along its kerbs."""
    lanes = max(2, round(width_m / 3.4)) if width_m >= TWO_LANES_M else 1
    for lane in range(lanes):
        canvas.allow(canvas.band(road, ((lane + 0.5) / lanes - 0.5) * width_m, 0.5))
    if kerbed and width_m >= PARKED_ALONG_M:
        for side in (-1, 1):
            canvas.allow(canvas.band(road, side * (width_m / 2 - 1.1), 0.3))


def add_street_furniture(canvas: Canvas, v_m: float) -> None:
    """Adds lamp posts and street trees in a row along u."""
    rng = canvas.rng
    spacing_m = rng.uniform(9, 22)
    start_m = rng.uniform(0, 9)
    trees = rng.random() < 0.6
    for u_m in np.arange(-canvas.reach_m + start_m, canvas.reach_m, spacing_m).tolist():
        if trees and rng.random() < 0.7:
            add_tree(canvas, (u_m, v_m), rng.uniform(1.2, 3.6))
        elif rng.random() < 0.5:
            add_lamp_post(canvas, (u_m, v_m))
