"""Paint on the roads of the procedural ground: lane and guide lines, bays, arrows."""

import math

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Patch, Place, beside

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
    style = rng.choice(["none", "dashed", "solid"], p=[0.25, 0.55, 0.2])
    dashes_m = _dashes(rng)
    for lane in range(1, lanes):
        line = canvas.band(road, (lane / lanes - 0.5) * width_m, rng.uniform(0.12, 0.2))
        if style != "none":
            mark(canvas, line, _dashed(line, *dashes_m) if style == "dashed" else 1.0)
    if rng.random() < 0.45:
        # The edge of some roads is a cycle lane's, and dashed.
        inset_m = 0.35 if rng.random() < 0.6 else rng.uniform(1.2, 2.0)
        dashes_m = _dashes(rng) if rng.random() < 0.4 else (1.0, 0.0)
        for side in (-1, 1):
            line = canvas.band(road, side * (width_m / 2 - inset_m), 0.12)
            mark(canvas, line, _dashed(line, *dashes_m))


def mark_guides(canvas: Canvas, along: Patch, centre_v_m: float, crossed: Patch) -> None:
    """Marks a pair of dashed lines, or of rows of squares, that lead a path across a road.

    `along` is the whole canvas along the path, whose middle runs at `centre_v_m`. `crossed` is the
    road on the whole canvas.
    """
    rng = canvas.rng
    apart_m = rng.uniform(1.6, 4.6)
    width_m = canvas.either(0.12, 0.2, 0.25, 0.5)
    dashes_m = (width_m, width_m) if width_m > 0.4 else _dashes(rng)
    for side in (-1, 1):
        line = canvas.band(along, centre_v_m + side * apart_m / 2, width_m)
        mark(canvas, line, _dashed(line, *dashes_m) * crossed.coverage)


def mark_bays(canvas: Canvas, road: Patch, width_m: float) -> None:
    """Marks a row of bays for parking along one kerb of a road, or the lines between them alone."""
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
    """Draws the lengths of a line's dashes and gaps, from half a metre to twelve."""
    dash_m = math.exp(rng.uniform(math.log(0.5), math.log(6.0)))
    return dash_m, dash_m * rng.uniform(0.6, 2.2)


def _dashed(line: Patch, dash_m: float, gap_m: float) -> Array:
    return (np.mod(line.u, dash_m + gap_m) < dash_m).astype(np.float32)
