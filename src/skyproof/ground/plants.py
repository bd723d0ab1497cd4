"""Plants of the procedural ground: trees, bushes and hedges."""

from __future__ import annotations

import math

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Colour, Place, pick

CROWN_COLOURS: tuple[Colour, ...] = (
    (70, 92, 48),
    (58, 82, 50),
    (88, 102, 54),
    (96, 96, 58),
    (50, 70, 46),
    (112, 118, 62),
    (38, 52, 40),
    (62, 52, 54),
)


def add_stand(canvas: Canvas, place: Place, reach_m: float) -> None:
    """Plants trees so near to each other that their crowns close, most of them of one kind.

    Dark gaps are left between some of them, as large as a vehicle and as black as one.
    """
    rng = canvas.rng
    kind = pick(canvas, CROWN_COLOURS, 0.1)
    largest_m = float(rng.uniform(2.0, 4.5))
    for _ in range(math.ceil(2.2 * (reach_m / largest_m) ** 2)):
        distance_m = reach_m * math.sqrt(float(rng.uniform()))
        angle_rad = float(rng.uniform(0, 2 * math.pi))
        spot = (
            place[0] + distance_m * math.cos(angle_rad),
            place[1] + distance_m * math.sin(angle_rad),
        )
        own = kind * np.float32(np.exp(rng.normal(0, 0.12))) if rng.random() < 0.8 else None
        add_tree(canvas, spot, largest_m * float(rng.uniform(0.6, 1.0)), own)
    for _ in range(int(rng.poisson(0.05 * reach_m**2))):
        off_m = rng.normal(0, reach_m / 2, 2)
        spot = (place[0] + float(off_m[0]), place[1] + float(off_m[1]))
        gap = canvas.disc(spot, float(rng.uniform(0.6, 1.4)), 0.2, float(rng.uniform(1.0, 2.4)))
        canvas.shade(gap, float(rng.uniform(0.12, 0.5)))


def add_tree(canvas: Canvas, place: Place, radius_m: float, colour: Array | None = None) -> None:
    """Plants a crown of many leaf clumps, high in the middle and ragged at its edge."""
    rng = canvas.rng
    patch = canvas.disc(place, radius_m, raggedness=0.16, stretch=float(rng.uniform(1.0, 1.25)))
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    dome = np.sqrt(np.clip(patch.inside / radius_m, 0, 1))
    top_m = float(rng.uniform(1.2, 2.2)) * radius_m
    canvas.raise_to(
        patch, np.clip(top_m * (0.35 + 0.65 * dome) + 0.4 * clumps + 0.12 * leaves, 0.3, None)
    )
    colour = pick(canvas, CROWN_COLOURS, 0.16) if colour is None else colour
    uneven = canvas.noise("mottle", patch)
    factor = np.exp(0.26 * clumps + 0.24 * leaves + 0.18 * uneven - 0.35 * (1 - dome) - 0.15)
    # Gaps between the clumps show the dark inside of the crown, and at a thin edge the ground.
    gaps = np.clip(1.0 - 0.9 * (clumps < -1.1), 0.25, 1)
    canvas.paint(patch, colour * (factor * gaps)[..., None].astype(np.float32))


def add_bush(canvas: Canvas, place: Place, radius_m: float) -> None:
    """Plants a low bush: a crown near the ground."""
    patch = canvas.disc(
        place, radius_m, raggedness=0.25, stretch=float(canvas.rng.uniform(1.0, 1.6))
    )
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    canvas.raise_to(
        patch,
        np.clip(
            0.9 * radius_m * np.sqrt(np.clip(patch.inside / radius_m, 0, 1)) + 0.2 * clumps, 0, 2.5
        ),
    )
    colour = pick(canvas, CROWN_COLOURS, 0.2)
    canvas.paint(
        patch, colour * np.exp(0.25 * clumps + 0.25 * leaves)[..., None].astype(np.float32)
    )


def add_hedge(canvas: Canvas, place: Place, length_m: float, angle_rad: float) -> None:
    """Plants a clipped hedge about a metre wide."""
    patch = canvas.rectangle(place, (length_m, float(canvas.rng.uniform(0.7, 1.3))), angle_rad, 0.3)
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    canvas.raise_to(patch, float(canvas.rng.uniform(0.9, 1.9)) + 0.12 * clumps)
    canvas.paint(
        patch,
        pick(canvas, CROWN_COLOURS)
        * np.exp(0.2 * clumps + 0.25 * leaves)[..., None].astype(np.float32),
    )
