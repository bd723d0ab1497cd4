"""Buildings of the procedural ground: tiled, metal, rusty and flat roofs, and things on them."""

import math

import numpy as np

from skyproof.ground.canvas import Canvas, Patch, Place, beside, palette, reflectance
from skyproof.ground.clutter import add_air_conditioner

ROOF_COLOURS = {
    "tiled": palette("a8543a 8c4838 78463c 605450 56585e b26e4c"),
    "metal": palette("b0b4b8 ced0ce 7e868e 5c748c 7a8c7a"),
    "village": palette("966048 aa8c78 bebab4 822c32 788c76"),
    "flat": palette("96948e bebcb4 707072 d8d6ce 5c5e62"),
}
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
        tone = canvas.pick(ROOF_COLOURS[kind])
        colour = canvas.varied(patch, tone, grain=0.07, mottle=0.10)
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
    seams = (np.mod(patch.u, 3.1) < 0.12) | (np.mod(patch.v, 7.3) < 0.12)
    colour = colour * np.where(seams, 0.88, 1.0).astype(np.float32)[..., None]
    puddles = np.clip(canvas.noise("patch", patch) - 0.8, 0, 0.8)[..., None]
    colour = colour * (1 - 0.5 * puddles)
    parapet = np.clip(base * rng.uniform(0.9, 1.5), 0, 0.85)
    canvas.paint(patch, np.where(edge[..., None], parapet, colour))


def _roof_furniture(
    canvas: Canvas, place: Place, size_m: Place, angle_rad: float, kind: str
) -> None:
    """Puts roof lights, solar panels, chimneys or air conditioning on a roof: boxes on a plain."""
    rng = canvas.rng
    half_u, half_v = size_m[0] / 2 - 1.2, size_m[1] / 2 - 1.2
    if half_u <= 0.5 or half_v <= 0.5 or kind == "village":
        return
    if rng.random() < 0.55:
        _roof_lights(canvas, place, (half_u, half_v), angle_rad, 1.4 if kind == "tiled" else 3.0)
    if kind == "tiled":
        if rng.random() < 0.6:
            u_m = rng.uniform(-half_u, half_u)
            _chimney(
                canvas, beside(place, angle_rad, u_m, rng.uniform(-0.4, 0.4) * half_v), angle_rad
            )
        if rng.random() < 0.15:
            spot = beside(place, angle_rad, rng.uniform(-0.4, 0.4) * half_u, 0.5 * half_v)
            panels_m = (min(half_u, rng.uniform(2, 5)), min(half_v, 2.2))
            _solar_panels(canvas, spot, panels_m, angle_rad)
        return
    if rng.random() < 0.12:
        _solar_panels(canvas, place, (half_u * 1.4, half_v * 0.7), angle_rad)
    for _ in range(rng.poisson(min(size_m[0] * size_m[1] / 60, 8))):
        u_m = rng.uniform(-half_u, half_u)
        spot = beside(place, angle_rad, u_m, rng.uniform(-half_v, half_v))
        add_air_conditioner(canvas, spot, angle_rad)


def _roof_lights(
    canvas: Canvas, place: Place, half_m: Place, angle_rad: float, longest_m: float
) -> None:
    """Puts a row of roof lights along a roof."""
    rng = canvas.rng
    size_m = (rng.uniform(0.8, 1.4), rng.uniform(1.0, longest_m))
    row_v = rng.uniform(0.25, 0.8) * half_m[1] * canvas.either(-1, 1)
    spacing_m = rng.uniform(2.0, 4.5)
    colour = reflectance((214, 218, 222) if rng.random() < 0.5 else (60, 70, 82))
    for u_m in np.arange(-half_m[0] + 1, half_m[0] - 1, spacing_m).tolist():
        spot = beside(place, angle_rad, u_m, row_v)
        canvas.paint(canvas.rectangle(spot, size_m, angle_rad), colour * rng.uniform(0.8, 1.2))
        pane_m = (size_m[0] - 0.4, size_m[1] - 0.4)
        canvas.paint(canvas.rectangle(spot, pane_m, angle_rad), colour * 0.75)


def _chimney(canvas: Canvas, place: Place, angle_rad: float) -> None:
    chimney = canvas.rectangle(place, (0.7, 0.9), angle_rad)
    canvas.raise_to(chimney, canvas.base_height(place) + 1.2)
    canvas.paint(chimney, canvas.pick(_CHIMNEYS))
    canvas.paint(canvas.rectangle(place, (0.35, 0.5), angle_rad), reflectance((40, 38, 36)))


def _solar_panels(canvas: Canvas, place: Place, size_m: Place, angle_rad: float) -> None:
    patch = canvas.rectangle(place, size_m, angle_rad)
    lines = (np.mod(patch.u, 1.0) < 0.1) | (np.mod(patch.v, 1.65) < 0.1)
    colour = np.where(lines[..., None], reflectance((150, 156, 165)), reflectance((34, 40, 62)))
    canvas.paint(patch, colour)
