"""Buildings of the procedural ground: tiled, metal, rusty and flat roofs, and things on them."""

from __future__ import annotations

import math

import numpy as np

from skyproof.ground.canvas import Canvas, Colour, Patch, Place, beside, pick, reflectance, textured
from skyproof.ground.clutter import add_air_conditioner

TILE_COLOURS: tuple[Colour, ...] = (
    (168, 84, 58),
    (140, 72, 56),
    (120, 70, 60),
    (96, 84, 80),
    (86, 88, 94),
    (178, 110, 76),
)
METAL_COLOURS: tuple[Colour, ...] = (
    (176, 180, 184),
    (206, 208, 206),
    (126, 134, 142),
    (92, 116, 140),
    (122, 140, 122),
)
RUSTY_COLOURS: tuple[Colour, ...] = (
    (150, 96, 72),
    (170, 140, 120),
    (190, 186, 180),
    (130, 44, 50),
    (120, 140, 118),
)
FLAT_COLOURS: tuple[Colour, ...] = (
    (150, 148, 142),
    (190, 188, 180),
    (112, 112, 114),
    (216, 214, 206),
    (92, 94, 98),
)


def add_building(
    canvas: Canvas, place: Place, size_m: tuple[float, float], angle_rad: float, kind: str
) -> None:
    """Builds a house of a kind: tiled, village (rusty sheets), metal or flat.

    Its length is along its ridge.
    """
    patch = canvas.rectangle(place, size_m, angle_rad)
    if patch.empty:
        return
    rng = canvas.rng
    if kind == "flat":
        _flat_roof(canvas, patch, place, size_m, angle_rad)
        return
    half_width = size_m[1] / 2
    pitch = float(rng.uniform(0.35, 0.75)) if kind == "tiled" else float(rng.uniform(0.08, 0.3))
    run = half_width - np.abs(patch.v)
    hipped = kind == "tiled" and rng.random() < 0.4
    if hipped:
        run = np.minimum(run, size_m[0] / 2 - np.abs(patch.u))
    eaves_m = {
        "tiled": rng.uniform(2.6, 6.0),
        "village": rng.uniform(2.2, 3.2),
        "metal": rng.uniform(4, 8),
    }[kind]
    canvas.raise_to(patch, eaves_m + pitch * run)

    if kind == "tiled":
        colour = textured(canvas, patch, pick(canvas, TILE_COLOURS), 0.07, 0.10)
        courses = (
            1
            + 0.09 * np.sign(np.sin(2 * math.pi * run / 0.36))
            + 0.03 * np.sin(2 * math.pi * patch.u / 0.3)
        )
    else:
        sheet_m = rng.uniform(0.8, 1.1)
        sheet = np.floor(patch.u / sheet_m + 50).astype(int) * 2 + (patch.v > 0)
        spread, colours = (0.22, RUSTY_COLOURS) if kind == "village" else (0.03, METAL_COLOURS)
        tones = np.exp(rng.normal(0, spread, 400)).astype(np.float32)
        colour = (
            textured(canvas, patch, pick(canvas, colours), 0.03, 0.05)
            * tones[sheet % 400][..., None]
        )
        if kind == "village":
            rust = np.clip(canvas.noise("mottle", patch) * 0.5 + rng.normal(0.1, 0.3), 0, 1)[
                ..., None
            ]
            colour = colour + rust * 0.7 * (reflectance((128, 84, 60)) - colour)
        courses = 1 + 0.07 * np.sin(2 * math.pi * patch.u / rng.choice([0.25, 0.5]))
    canvas.paint(patch, colour * courses[..., None])
    ridge = canvas.rectangle(place, (size_m[0] - (size_m[1] if hipped else 0), 0.25), angle_rad)
    canvas.shade(ridge, float(rng.choice([0.75, 1.25])))
    _roof_furniture(canvas, place, size_m, angle_rad, kind)


def _flat_roof(
    canvas: Canvas, patch: Patch, place: Place, size_m: tuple[float, float], angle_rad: float
) -> None:
    rng = canvas.rng
    height_m = float(rng.uniform(3, 9))
    parapet_m = float(rng.uniform(0.2, 0.7))
    edge = patch.inside < 0.35
    canvas.raise_to(patch, np.where(edge, height_m + parapet_m, height_m))
    base = pick(canvas, FLAT_COLOURS)
    colour = textured(canvas, patch, base, 0.06, 0.08)
    seams = (np.mod(patch.u, 3.1) < 0.12) | (np.mod(patch.v, 7.3) < 0.12)
    colour = colour * np.where(seams, 0.88, 1.0).astype(np.float32)[..., None]
    puddles = np.clip(canvas.noise("patch", patch) - 0.8, 0, 0.8)[..., None]
    colour = colour * (1 - 0.5 * puddles)
    canvas.paint(
        patch, np.where(edge[..., None], np.clip(base * rng.uniform(0.9, 1.5), 0, 0.85), colour)
    )
    _roof_furniture(canvas, place, size_m, angle_rad, "flat")


def _roof_furniture(
    canvas: Canvas, place: Place, size_m: tuple[float, float], angle_rad: float, kind: str
) -> None:
    """Puts roof lights, solar panels, chimneys or air conditioning on a roof.

    They are bright and dark boxes on a large plain shape.
    """
    rng = canvas.rng
    half_u, half_v = size_m[0] / 2 - 1.2, size_m[1] / 2 - 1.2
    if half_u <= 0.5 or half_v <= 0.5 or kind == "village":
        return
    area = size_m[0] * size_m[1]
    glass = reflectance((60, 70, 82))
    bright = reflectance((214, 218, 222))
    if rng.random() < 0.55:  # a row of roof lights
        light_m = (
            float(rng.uniform(0.8, 1.4)),
            float(rng.uniform(1.0, 3.0 if kind != "tiled" else 1.4)),
        )
        row_v = float(rng.uniform(0.25, 0.8)) * half_v * float(rng.choice([-1, 1]))
        spacing = float(rng.uniform(2.0, 4.5))
        colour = bright if rng.random() < 0.5 else glass
        for u_m in np.arange(-half_u + 1, half_u - 1, spacing):
            pane = canvas.rectangle(beside(place, angle_rad, float(u_m), row_v), light_m, angle_rad)
            canvas.paint(pane, colour * float(rng.uniform(0.8, 1.2)))
            canvas.paint(
                canvas.rectangle(
                    beside(place, angle_rad, float(u_m), row_v),
                    (light_m[0] - 0.4, light_m[1] - 0.4),
                    angle_rad,
                ),
                colour * 0.75,
            )
    if kind == "tiled":
        if rng.random() < 0.6:
            spot = beside(
                place,
                angle_rad,
                float(rng.uniform(-half_u, half_u)),
                float(rng.uniform(-0.4, 0.4)) * half_v,
            )
            chimney = canvas.rectangle(spot, (0.7, 0.9), angle_rad)
            canvas.raise_to(chimney, canvas.base_height(spot) + 1.2)
            canvas.paint(chimney, pick(canvas, ((150, 90, 70), (170, 166, 160))))
            canvas.paint(canvas.rectangle(spot, (0.35, 0.5), angle_rad), reflectance((40, 38, 36)))
        if rng.random() < 0.15:
            spot = beside(place, angle_rad, float(rng.uniform(-0.4, 0.4)) * half_u, 0.5 * half_v)
            _solar_panels(
                canvas, spot, (min(half_u, float(rng.uniform(2, 5))), min(half_v, 2.2)), angle_rad
            )
        return
    if rng.random() < 0.12:
        _solar_panels(canvas, place, (half_u * 1.4, half_v * 0.7), angle_rad)
    for _ in range(int(rng.poisson(min(area / 60, 8)))):
        spot = beside(
            place,
            angle_rad,
            float(rng.uniform(-half_u, half_u)),
            float(rng.uniform(-half_v, half_v)),
        )
        add_air_conditioner(canvas, spot, angle_rad)


def _solar_panels(
    canvas: Canvas, place: Place, size_m: tuple[float, float], angle_rad: float
) -> None:
    patch = canvas.rectangle(place, size_m, angle_rad)
    lines = (np.mod(patch.u, 1.0) < 0.1) | (np.mod(patch.v, 1.65) < 0.1)
    colour = np.where(lines[..., None], reflectance((150, 156, 165)), reflectance((34, 40, 62)))
    canvas.paint(patch, colour.astype(np.float32))
