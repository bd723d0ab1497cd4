"""Small things of the procedural ground, many of about a car's size: boxes, sheds, pools, posts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from skyproof.ground.canvas import (
    Array,
    Canvas,
    Patch,
    Place,
    beside,
    pick,
    reflectance,
    textured,
)
from skyproof.vehicles.paints import PAINT_SHARES, PAINT_TONES

# Things of a car's size wear the vehicles' own paints as often as vehicles do: a colour that only
# one of the two has would be taken for evidence.
_PAINT_NAMES = tuple(PAINT_SHARES)
_PAINT_SHARES = np.asarray([PAINT_SHARES[name] for name in _PAINT_NAMES])


def _painted(canvas: Canvas) -> Array:
    """Reflectance of a vehicle's paint, a little off."""
    name = _PAINT_NAMES[int(canvas.rng.choice(len(_PAINT_NAMES), p=_PAINT_SHARES))]
    tones = tuple(
        (round(255 * red), round(255 * green), round(255 * blue))
        for red, green, blue in PAINT_TONES[name]
    )
    return pick(canvas, tones)


def add_lamp_post(canvas: Canvas, place: Place) -> None:
    """A thin post: little to see but its long shadow."""
    post = canvas.disc(place, 0.14)
    canvas.raise_to(post, float(canvas.rng.uniform(4, 8)))
    canvas.paint(post, reflectance((190, 190, 186)))


def add_manhole(canvas: Canvas, place: Place) -> None:
    """A round or square cover in the road."""
    side = float(canvas.rng.uniform(0.5, 0.8))
    patch = (
        canvas.disc(place, side / 2)
        if canvas.rng.random() < 0.6
        else canvas.rectangle(place, (side, side))
    )
    canvas.shade(patch, float(canvas.rng.uniform(0.55, 0.8)))


def _box(
    canvas: Canvas,
    place: Place,
    size_m: tuple[float, float, float],
    angle_rad: float,
    colour: Array,
) -> Patch:
    """A plain box standing on whatever is there."""
    patch = canvas.rectangle(place, size_m[:2], angle_rad)
    if not patch.empty:
        canvas.raise_to(patch, canvas.base_height(place) + size_m[2])
        canvas.paint(patch, textured(canvas, patch, colour, 0.04, 0.05))
    return patch


def add_air_conditioner(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A pale box with dark fans."""
    rng = canvas.rng
    length = float(rng.uniform(1.0, 3.2))
    _box(
        canvas,
        place,
        (length, float(rng.uniform(0.9, 1.6)), 0.9),
        angle_rad,
        pick(canvas, ((190, 192, 192), (150, 152, 154))),
    )
    for u_m in np.arange(-length / 2 + 0.55, length / 2 - 0.4, 1.0):
        canvas.paint(
            canvas.disc(beside(place, angle_rad, float(u_m), 0.0), 0.33), reflectance((62, 64, 66))
        )


def add_container(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A shipping container, half or full length, with its ribs."""
    length = float(canvas.rng.choice([3.0, 6.06, 6.06, 12.2]))
    patch = _box(canvas, place, (length, 2.44, 2.6), angle_rad, _painted(canvas))
    canvas.shade(patch, (1 + 0.1 * np.sin(2 * math.pi * patch.u / 0.55)).astype(np.float32))


def add_skip(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """An open skip: a bright rim, sloping dark walls, rubble."""
    rng = canvas.rng
    size = (float(rng.uniform(3.0, 4.6)), float(rng.uniform(1.6, 2.0)))
    _box(canvas, place, (*size, 1.3), angle_rad, _painted(canvas))
    hollow = canvas.rectangle(place, (size[0] - 0.5, size[1] - 0.4), angle_rad)
    if not hollow.empty:
        fill = textured(
            canvas, hollow, pick(canvas, ((110, 100, 90), (94, 88, 82), (150, 140, 126))), 0.15, 0.2
        )
        canvas.paint(hollow, fill * np.exp(0.3 * canvas.noise("clump", hollow))[..., None])


def add_shed(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A garden shed or greenhouse with a small ridge, of about a car's outline."""
    rng = canvas.rng
    size = (float(rng.uniform(2.2, 5.2)), float(rng.uniform(1.6, 2.6)))
    patch = canvas.rectangle(place, size, angle_rad)
    if patch.empty:
        return
    canvas.raise_to(patch, 2.0 + 0.35 * (size[1] / 2 - np.abs(patch.v)))
    colours = ((120, 96, 72), (90, 88, 86), (190, 196, 198), (104, 106, 108), (150, 120, 90))
    canvas.paint(patch, textured(canvas, patch, pick(canvas, colours), 0.05, 0.06))
    if rng.random() < 0.4:
        for u_m in (-size[0] / 4, size[0] / 4):
            canvas.paint(
                canvas.rectangle(
                    beside(place, angle_rad, u_m, 0.0), (0.6, size[1] * 0.7), angle_rad
                ),
                reflectance((52, 58, 66)),
            )


def add_painted_box(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Lays paint or a plate of a car's proportions, seldom with two dark cross bands like glass."""
    rng = canvas.rng
    size = (float(rng.uniform(3.6, 5.2)), float(rng.uniform(1.6, 2.1)))
    patch = canvas.rectangle(place, size, angle_rad, float(rng.uniform(0, 0.5)))
    if patch.empty:
        return
    worn = np.clip(0.85 + 0.2 * canvas.noise("mottle", patch), 0.3, 1)
    canvas.paint(patch, _painted(canvas), worn)
    if rng.random() < 0.15:
        for u_m in (-0.3 * size[0], 0.2 * size[0]):
            canvas.paint(
                canvas.rectangle(
                    beside(place, angle_rad, u_m, 0.0), (0.6, size[1] * 0.8), angle_rad
                ),
                reflectance((50, 52, 56)),
                0.8,
            )


def add_pool(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A garden pool with its pale surround."""
    rng = canvas.rng
    size = (float(rng.uniform(3.5, 9)), float(rng.uniform(2.5, 4.5)))
    canvas.paint(
        canvas.rectangle(place, (size[0] + 1.6, size[1] + 1.6), angle_rad),
        pick(canvas, ((200, 192, 178), (170, 160, 148))),
    )
    water = canvas.rectangle(place, size, angle_rad, float(rng.uniform(0, 1.2)))
    if not water.empty:
        canvas.paint(
            water,
            textured(
                canvas,
                water,
                pick(canvas, ((90, 170, 190), (70, 140, 170), (60, 100, 100))),
                0.05,
                0.08,
            ),
        )


def add_pallets(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Stacks of pallets or wrapped goods, side by side."""
    rng = canvas.rng
    wood = pick(canvas, ((170, 140, 100), (140, 118, 90), (200, 204, 206), (60, 62, 66)))
    for i in range(int(rng.integers(1, 5))):
        spot = beside(place, angle_rad, 1.3 * i - 2.0, float(rng.normal(0, 0.1)))
        patch = _box(
            canvas,
            spot,
            (1.2, 1.0, float(rng.uniform(0.3, 1.8))),
            angle_rad,
            wood * float(rng.uniform(0.8, 1.2)),
        )
        canvas.shade(patch, np.where(np.mod(patch.v, 0.28) < 0.1, 0.7, 1.0).astype(np.float32))


def add_bins(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """One to four wheeled bins in a row."""
    rng = canvas.rng
    for i in range(int(rng.integers(1, 5))):
        spot = beside(place, angle_rad, 0.75 * i, 0.0)
        _box(
            canvas,
            spot,
            (0.6, float(rng.uniform(0.7, 1.2)), 1.1),
            angle_rad,
            pick(canvas, ((60, 76, 60), (52, 56, 62), (90, 74, 56), (60, 80, 120))),
        )


def add_bench(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A bench or a table with its two benches."""
    wood = pick(canvas, ((150, 120, 90), (110, 100, 92)))
    for v_m, width in ((0.0, 0.7), (0.75, 0.3), (-0.75, 0.3)):
        _box(canvas, beside(place, angle_rad, 0.0, v_m), (1.8, width, 0.6), angle_rad, wood)


def add_tarpaulin(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A covered heap about as large as a car: soft outline, smooth top."""
    rng = canvas.rng
    patch = canvas.rectangle(
        place, (float(rng.uniform(2.5, 5)), float(rng.uniform(1.6, 2.4))), angle_rad, 0.6
    )
    if not patch.empty:
        canvas.raise_to(
            patch,
            0.3
            + np.clip(
                1.1 * np.sqrt(np.clip(patch.inside, 0, 1)) + 0.1 * canvas.noise("clump", patch),
                0,
                1.6,
            ),
        )
        canvas.paint(
            patch,
            textured(
                canvas,
                patch,
                _painted(canvas),
                0.03,
                0.1,
            ),
        )


CLUTTER: dict[str, Callable[[Canvas, Place, float], None]] = {
    "air conditioner": add_air_conditioner,
    "bench": add_bench,
    "bins": add_bins,
    "container": add_container,
    "painted box": add_painted_box,
    "pallets": add_pallets,
    "pool": add_pool,
    "shed": add_shed,
    "skip": add_skip,
    "tarpaulin": add_tarpaulin,
}
"""Things a careless detector takes for cars."""


def add_clutter(canvas: Canvas, place: Place, angle_rad: float, kinds: tuple[str, ...]) -> None:
    """One thing of the named kinds; mostly in line with `angle_rad`, sometimes askew."""
    rng = canvas.rng
    askew = float(rng.normal(0, 0.05)) if rng.random() < 0.7 else float(rng.uniform(0, math.pi))
    CLUTTER[kinds[int(rng.integers(len(kinds)))]](canvas, place, angle_rad + askew)
