"""Plants of the procedural ground: trees, bushes and hedges."""

import math

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Place, palette

CROWN_COLOURS = palette("465c30 3a5232 586636 60603a 32462e 70763e 263428 3e3436")


def add_stand(canvas: Canvas, place: Place, reach_m: float) -> None:
    """Plants trees so near to each other that their crowns close, most of them of one kind.

    Dark gaps are left between some of them, as large as a vehicle and as black as one.
    """
    rng = canvas.rng
    kind = canvas.pick(CROWN_COLOURS, 0.1)
    largest_m = rng.uniform(2.0, 4.5)
    for _ in range(math.ceil(2.2 * (reach_m / largest_m) ** 2)):
        distance_m = reach_m * math.sqrt(rng.uniform())
        angle_rad = rng.uniform(0, 2 * math.pi)
        x_m, y_m = distance_m * math.cos(angle_rad), distance_m * math.sin(angle_rad)
        alike = kind * np.float32(np.exp(rng.normal(0, 0.12))) if rng.random() < 0.8 else None
        spot = (place[0] + x_m, place[1] + y_m)
        add_tree(canvas, spot, largest_m * rng.uniform(0.6, 1.0), alike)
    for _ in range(rng.poisson(0.05 * reach_m**2)):
        x_m, y_m = rng.normal(0, reach_m / 2, 2)
        spot = (place[0] + x_m, place[1] + y_m)
        gap = canvas.disc(spot, rng.uniform(0.6, 1.4), 0.2, rng.uniform(1.0, 2.4))
        canvas.shade(gap, rng.uniform(0.12, 0.5))


def add_tree(canvas: Canvas, place: Place, radius_m: float, colour: Array | None = None) -> None:
    """Plants a crown of many leaf clumps, high in the middle and ragged at its edge."""
    patch = canvas.disc(place, radius_m, raggedness=0.16, stretch=canvas.rng.uniform(1.0, 1.25))
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    dome = np.sqrt(np.clip(patch.inside / radius_m, 0, 1))
    top_m = canvas.rng.uniform(1.2, 2.2) * radius_m
    height_m = top_m * (0.35 + 0.65 * dome) + 0.4 * clumps + 0.12 * leaves
    canvas.raise_to(patch, np.clip(height_m, 0.3, None))
    colour = canvas.pick(CROWN_COLOURS, 0.16) if colour is None else colour
    uneven = canvas.noise("mottle", patch)
    factor = np.exp(0.26 * clumps + 0.24 * leaves + 0.18 * uneven - 0.35 * (1 - dome) - 0.15)
    # Gaps between the clumps show the dark inside of the crown, and at a thin edge the ground.
    gaps = np.clip(1.0 - 0.9 * (clumps < -1.1), 0.25, 1)
    canvas.paint(patch, colour * (factor * gaps)[..., None].astype(np.float32))


def add_bush(canvas: Canvas, place: Place, radius_m: float) -> None:
    """Plants a low bush: a crown near the ground."""
    patch = canvas.disc(place, radius_m, raggedness=0.25, stretch=canvas.rng.uniform(1.0, 1.6))
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    dome = np.sqrt(np.clip(patch.inside / radius_m, 0, 1))
    canvas.raise_to(patch, np.clip(0.9 * radius_m * dome + 0.2 * clumps, 0, 2.5))
    colour = canvas.pick(CROWN_COLOURS, 0.2)
    canvas.paint(patch, colour * np.exp(0.25 * clumps + 0.25 * leaves)[..., None])


def add_hedge(canvas: Canvas, place: Place, length_m: float, angle_rad: float) -> None:
    """Plants a clipped hedge about a metre wide."""
    patch = canvas.rectangle(place, (length_m, canvas.rng.uniform(0.7, 1.3)), angle_rad, 0.3)
    if patch.empty:
        return
    clumps = canvas.noise("clump", patch)
    leaves = canvas.noise("grain", patch)
    canvas.raise_to(patch, canvas.rng.uniform(0.9, 1.9) + 0.12 * clumps)
    colour = canvas.pick(CROWN_COLOURS)
    canvas.paint(patch, colour * np.exp(0.2 * clumps + 0.25 * leaves)[..., None])
