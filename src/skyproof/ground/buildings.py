"""Buildings of the procedural ground: tiled, metal, rusty and flat roofs, and things on them."""

import math

import numpy as np

from skyproof.ground.canvas import Canvas, Patch, Place, beside, palette, reflectance
from skyproof.ground.clutter import add_air_conditioner

ROOF_COLOURS = {
    "tiled": palette("a8543a 8c4838 78463c 605450 56585e b26e4c"),
    "metal": palette("b0b4b8 ced0ce 7e868e 5c748c 7a8c7a"),
    "village": palette("966048 aa8c78 bebab4 822c32 788c76"),
    "flat": palette("96948e bebcb4 707072 d8d6ce 5c5e62 484e56"),
}
_FRAMES = palette("e4e6e6 f0f0ec b4b8ba")
_PANES = palette("3c4652 86a8bc")
_MODULES = palette("22283e 34446c 7880a4")
_CHIMNEYS = palette("965a46 aaa6a0")
_EAVES_M = {"tiled": (2.6, 6.0), "village": (2.2, 3.2), "metal": (4.0, 8.0)}


def add_building(canvas: Canvas, place: Place, size_m: Place, angle_rad: float, kind: str) -> None:
    """Builds a house, its ridge along its length: tiled, village (rusty sheets), metal or flat."""
    patch = canvas.rectangle(place, size_m, angle_rad)
    if patch.empty:
        return
    if kind == "flat":
        _flat_roof(canvas, patch)
    else:
        _pitched_roof(canvas, patch, place, size_m, angle_rad, kind)
    _roof_furniture(canvas, place, size_m, angle_rad, kind)


def _pitched_roof(
    canvas: Canvas, patch: Patch, place: Place, size_m: Place, angle_rad: float, kind: str
) -> None:
    rng = canvas.rng
    pitch = rng.uniform(0.35, 0.75) if kind == "tiled" else rng.uniform(0.08, 0.3)
    run = size_m[1] / 2 - np.abs(patch.v)
    hipped = kind == "tiled" and rng.random() < 0.4
    if hipped:
        run = np.minimum(run, size_m[0] / 2 - np.abs(patch.u))
    eaves_m = {name: rng.uniform(*between) for name, between in _EAVES_M.items()}
    canvas.raise_to(patch, eaves_m[kind] + pitch * run)
    if kind == "tiled":
        colour = canvas.varied(patch, canvas.pick(ROOF_COLOURS[kind]), grain=0.07, mottle=0.10)
        courses = 1 + 0.09 * np.sign(np.sin(2 * math.pi * run / 0.36))
        courses = courses + 0.03 * np.sin(2 * math.pi * patch.u / 0.3)
    else:
        sheet_m = rng.uniform(0.8, 1.1)
        sheet = np.floor(patch.u / sheet_m + 50).astype(int) * 2 + (patch.v > 0)
        spread = 0.22 if kind == "village" else 0.03
        tones = np.exp(rng.normal(0, spread, 400)).astype(np.float32)
        colour = canvas.varied(patch, canvas.pick(ROOF_COLOURS[kind]), grain=0.03, mottle=0.05)
        colour = colour * tones[sheet % 400][..., None]
        if kind == "village":
            rust = np.clip(canvas.noise("mottle", patch) * 0.5 + rng.normal(0.1, 0.3), 0, 1)
            colour = colour + rust[..., None] * 0.7 * (reflectance((128, 84, 60)) - colour)
        courses = 1 + 0.07 * np.sin(2 * math.pi * patch.u / rng.choice([0.25, 0.5]))
    canvas.paint(patch, colour * courses[..., None])
    ridge = canvas.rectangle(place, (size_m[0] - (size_m[1] if hipped else 0), 0.25), angle_rad)
    canvas.shade(ridge, canvas.either(0.75, 1.25))


def _flat_roof(canvas: Canvas, patch: Patch) -> None:
    rng = canvas.rng
    height_m = rng.uniform(3, 9)
    parapet_m = rng.uniform(0.2, 0.7)
    edge = patch.inside < 0.35
    canvas.raise_to(patch, np.where(edge, height_m + parapet_m, height_m))
    base = canvas.pick(ROOF_COLOURS["flat"])
    colour = canvas.varied(patch, base, grain=0.06, mottle=0.08)
    seams = (np.mod(patch.u, rng.uniform(1.0, 3.5)) < 0.12) | (np.mod(patch.v, 7.3) < 0.12)
    colour = colour * np.where(seams, rng.uniform(0.6, 0.9), 1.0).astype(np.float32)[..., None]
    puddles = np.clip(canvas.noise("patch", patch) - 0.8, 0, 0.8)[..., None]
    colour = colour * (1 - 0.5 * puddles)
    parapet = np.clip(base * rng.uniform(0.9, 1.5), 0, 0.85)
    canvas.paint(patch, np.where(edge[..., None], parapet, colour))


def _roof_furniture(
    canvas: Canvas, place: Place, size_m: Place, angle_rad: float, kind: str
) -> None:
    """Puts roof lights, solar panels, a chimney and air conditioning on some roofs."""
    rng = canvas.rng
    half_u, half_v = size_m[0] / 2 - 1.2, size_m[1] / 2 - 1.2
    if half_u <= 0.5 or half_v <= 0.5 or kind == "village":
        return
    for _ in range(rng.integers(0, 3)):
        _roof_lights(canvas, place, (half_u, half_v), angle_rad)
    if rng.random() < 0.25:
        side = canvas.either(-1, 1) if kind == "tiled" else 0
        spot = beside(place, angle_rad, rng.uniform(-0.4, 0.4) * half_u, 0.5 * side * half_v)
        panels_m = (half_u * rng.uniform(0.5, 1.4), half_v * rng.uniform(0.5, 1.0))
        _solar_panels(canvas, spot, panels_m, angle_rad)
    if kind == "tiled" and rng.random() < 0.6:
        v_m = rng.uniform(-0.4, 0.4) * half_v
        _chimney(canvas, beside(place, angle_rad, rng.uniform(-half_u, half_u), v_m), angle_rad)
    for _ in range(rng.poisson(0.4 if kind == "tiled" else min(size_m[0] * size_m[1] / 60, 8))):
        spot_m = rng.uniform(-half_u, half_u), rng.uniform(-half_v, half_v)
        add = _add_ridge if kind == "flat" and rng.random() < 0.2 else add_air_conditioner
        turn_rad = canvas.either(0, math.pi / 2)
        add(canvas, beside(place, angle_rad, *spot_m), angle_rad + turn_rad)


def _roof_lights(canvas: Canvas, place: Place, half_m: Place, angle_rad: float) -> None:
    """Puts a row of small windows, or of large framed lights that stand high, along a roof."""
    rng = canvas.rng
    large = half_m[1] > 2.5 and rng.random() < 0.4
    larger = (1.7, 2.3, 5.0) if large else (1.0, 1.0, 1.0)
    width_m, length_m, rise_m = larger * rng.uniform((0.7, 1.0, 0.1), (1.2, 1.5, 0.2))
    row_v = rng.uniform(0.3, 0.8) * half_m[1] * canvas.either(-1, 1)
    frame, pane = canvas.pick(_FRAMES), canvas.pick(_FRAMES if large else _PANES)
    rings = ((0.0, frame, rise_m), (0.3, frame * 0.6, 0.0), (0.45, pane, 0.0))
    for u_m in np.arange(0.5 - half_m[0], half_m[0] - 0.5, width_m + rng.uniform(0.8, 3)).tolist():
        spot = beside(place, angle_rad, u_m, row_v)
        for inset_m, tone, higher_m in rings:
            ring = canvas.rectangle(spot, (width_m - inset_m, length_m - inset_m), angle_rad)
            canvas.raise_to(ring, canvas.height[ring.rows, ring.columns] + higher_m)
            canvas.paint(ring, tone * rng.uniform(0.9, 1.1))


def _add_ridge(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Puts a ribbed, rounded box for light or air on a flat roof."""
    width_m = canvas.rng.uniform(1.0, 1.5)
    ridge = canvas.rectangle(place, (canvas.rng.uniform(3.5, 5.5), width_m), angle_rad)
    arch = np.sqrt(np.clip(1 - (2 * ridge.v / width_m) ** 2, 0, 1))
    canvas.raise_to(ridge, canvas.base_height(place) + 0.3 + 0.6 * arch)
    ribs = np.where(np.mod(ridge.u, 0.75) < 0.14, 0.7, 1.0)
    canvas.paint(ridge, canvas.pick(_FRAMES) * canvas.rng.uniform(0.4, 0.9) * ribs[..., None])


def _chimney(canvas: Canvas, place: Place, angle_rad: float) -> None:
    chimney = canvas.rectangle(place, (0.7, 0.9), angle_rad)
    canvas.raise_to(chimney, canvas.base_height(place) + 1.2)
    canvas.paint(chimney, canvas.pick(_CHIMNEYS))
    canvas.paint(canvas.rectangle(place, (0.35, 0.5), angle_rad), reflectance((40, 38, 36)))


def _solar_panels(canvas: Canvas, place: Place, size_m: Place, angle_rad: float) -> None:
    """Lays rows of solar panels, with gaps between rows and where panels are missing."""
    rng = canvas.rng
    patch = canvas.rectangle(place, size_m, angle_rad)
    long_m, deep_m = canvas.either((1.0, 1.65), (1.65, 1.0))
    row_m = deep_m + canvas.either(0.0, 0.2, rng.uniform(0.2, 0.8))
    along, across = np.mod(patch.u, long_m), np.mod(patch.v, row_m)
    number = (31 * np.floor(patch.u / long_m) + 7 * np.floor(patch.v / row_m)).astype(int) % 400
    laid = (rng.random(400) < canvas.either(0.8, 0.95, 1.0))[number] & (across < deep_m)
    lines = (along < 0.1) | (across < 0.1)
    module = canvas.pick(_MODULES) * np.exp(rng.normal(0, 0.15, 400))[number][..., None]
    colour = np.where(lines[..., None], reflectance((150, 156, 165)), module)
    canvas.paint(patch, colour, laid)
