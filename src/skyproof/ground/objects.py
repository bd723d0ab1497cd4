"""Things that stand or lie on the procedural ground: buildings, trees, and clutter of about a car's size."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Colour, Patch, reflectance

__all__ = [
    "CLUTTER",
    "add_building",
    "add_bush",
    "add_clutter",
    "add_hedge",
    "add_lamp_post",
    "add_manhole",
    "add_tree",
]

Place = tuple[float, float]

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
CROWN_COLOURS: tuple[Colour, ...] = (
    (70, 92, 48),
    (58, 82, 50),
    (88, 102, 54),
    (96, 96, 58),
    (50, 70, 46),
    (112, 118, 62),
)
CONTAINER_COLOURS: tuple[Colour, ...] = (
    (140, 50, 40),
    (40, 76, 120),
    (50, 96, 70),
    (190, 190, 186),
    (196, 130, 40),
)
PAINT_COLOURS: tuple[Colour, ...] = (
    (238, 238, 232),
    (28, 30, 34),
    (170, 40, 36),
    (40, 60, 130),
    (150, 154, 158),
    (84, 88, 92),
)


def pick(canvas: Canvas, colours: tuple[Colour, ...], spread: float = 0.12) -> Array:
    """One of the colours as reflectance, a little off, because no two roofs are alike."""
    colour = reflectance(colours[int(canvas.rng.integers(len(colours)))])
    return (
        colour * np.exp(canvas.rng.normal(0, spread) + canvas.rng.normal(0, spread / 3, 3))
    ).astype(np.float32)


def textured(canvas: Canvas, patch: Patch, colour: Array, grain: float, mottle: float) -> Array:
    """A colour varied by fine grain and by stains of about a metre, `[h, w, 3]`."""
    factor = 1 + grain * canvas.noise("grain", patch) + mottle * canvas.noise("mottle", patch)
    return np.clip(factor, 0.2, 2.5)[..., None] * colour


def add_building(
    canvas: Canvas, place: Place, size_m: tuple[float, float], angle_rad: float, kind: str
) -> None:
    """A building; `kind` is tiled, village (rusty sheets), metal or flat. Length is along its ridge."""
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
    height_m, parapet_m = float(rng.uniform(3, 9)), float(rng.uniform(0.2, 0.7))
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


def _on(place: Place, angle_rad: float, u_m: float, v_m: float) -> Place:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return place[0] + cosine * u_m - sine * v_m, place[1] + sine * u_m + cosine * v_m


def _roof_furniture(
    canvas: Canvas, place: Place, size_m: tuple[float, float], angle_rad: float, kind: str
) -> None:
    """Roof lights, dormers, solar panels, chimneys, air conditioning: bright and dark boxes on a large plain shape."""
    rng = canvas.rng
    half_u, half_v = size_m[0] / 2 - 1.2, size_m[1] / 2 - 1.2
    if half_u <= 0.5 or half_v <= 0.5 or kind == "village":
        return
    area = size_m[0] * size_m[1]
    glass, bright = reflectance((60, 70, 82)), reflectance((214, 218, 222))
    if rng.random() < 0.55:  # a row of roof lights
        light_m = (
            float(rng.uniform(0.8, 1.4)),
            float(rng.uniform(1.0, 3.0 if kind != "tiled" else 1.4)),
        )
        row_v = float(rng.uniform(0.25, 0.8)) * half_v * float(rng.choice([-1, 1]))
        spacing = float(rng.uniform(2.0, 4.5))
        colour = bright if rng.random() < 0.5 else glass
        for u_m in np.arange(-half_u + 1, half_u - 1, spacing):
            pane = canvas.rectangle(_on(place, angle_rad, float(u_m), row_v), light_m, angle_rad)
            canvas.paint(pane, colour * float(rng.uniform(0.8, 1.2)))
            canvas.paint(
                canvas.rectangle(
                    _on(place, angle_rad, float(u_m), row_v),
                    (light_m[0] - 0.4, light_m[1] - 0.4),
                    angle_rad,
                ),
                colour * 0.75,
            )
    if kind == "tiled":
        if rng.random() < 0.6:
            spot = _on(
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
            spot = _on(place, angle_rad, float(rng.uniform(-0.4, 0.4)) * half_u, 0.5 * half_v)
            _solar_panels(
                canvas, spot, (min(half_u, float(rng.uniform(2, 5))), min(half_v, 2.2)), angle_rad
            )
        return
    if rng.random() < 0.12:
        _solar_panels(canvas, place, (half_u * 1.4, half_v * 0.7), angle_rad)
    for _ in range(int(rng.poisson(min(area / 60, 8)))):
        spot = _on(
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


def add_tree(canvas: Canvas, place: Place, radius_m: float) -> None:
    """A crown of many leaf clumps, high in the middle, ragged at its edge, shading itself and the ground."""
    rng = canvas.rng
    patch = canvas.disc(place, radius_m, raggedness=0.16, stretch=float(rng.uniform(1.0, 1.25)))
    if patch.empty:
        return
    clumps, leaves = canvas.noise("clump", patch), canvas.noise("grain", patch)
    dome = np.sqrt(np.clip(patch.inside / radius_m, 0, 1))
    top_m = float(rng.uniform(1.2, 2.2)) * radius_m
    canvas.raise_to(
        patch, np.clip(top_m * (0.35 + 0.65 * dome) + 0.4 * clumps + 0.12 * leaves, 0.3, None)
    )
    colour = pick(canvas, CROWN_COLOURS, 0.16)
    uneven = canvas.noise("mottle", patch)
    factor = np.exp(0.22 * clumps + 0.22 * leaves + 0.18 * uneven - 0.2 * (1 - dome))
    # Gaps between the clumps show the dark inside of the crown, and at a thin edge the ground.
    gaps = np.clip(1.0 - 0.9 * (clumps < -1.1), 0.25, 1)
    canvas.paint(patch, colour * (factor * gaps)[..., None].astype(np.float32))


def add_bush(canvas: Canvas, place: Place, radius_m: float) -> None:
    """A low bush: a crown near the ground."""
    patch = canvas.disc(
        place, radius_m, raggedness=0.25, stretch=float(canvas.rng.uniform(1.0, 1.6))
    )
    if patch.empty:
        return
    clumps, leaves = canvas.noise("clump", patch), canvas.noise("grain", patch)
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
    """A clipped hedge about a metre wide."""
    patch = canvas.rectangle(place, (length_m, float(canvas.rng.uniform(0.7, 1.3))), angle_rad, 0.3)
    if patch.empty:
        return
    clumps, leaves = canvas.noise("clump", patch), canvas.noise("grain", patch)
    canvas.raise_to(patch, float(canvas.rng.uniform(0.9, 1.9)) + 0.12 * clumps)
    canvas.paint(
        patch,
        pick(canvas, CROWN_COLOURS)
        * np.exp(0.2 * clumps + 0.25 * leaves)[..., None].astype(np.float32),
    )


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
            canvas.disc(_on(place, angle_rad, float(u_m), 0.0), 0.33), reflectance((62, 64, 66))
        )


def add_container(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """A shipping container, half or full length, with its ribs."""
    length = float(canvas.rng.choice([3.0, 6.06, 6.06, 12.2]))
    patch = _box(canvas, place, (length, 2.44, 2.6), angle_rad, pick(canvas, CONTAINER_COLOURS))
    canvas.shade(patch, (1 + 0.1 * np.sin(2 * math.pi * patch.u / 0.55)).astype(np.float32))


def add_skip(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """An open skip: a bright rim, sloping dark walls, rubble."""
    rng = canvas.rng
    size = (float(rng.uniform(3.0, 4.6)), float(rng.uniform(1.6, 2.0)))
    colour = pick(canvas, ((200, 160, 40), (60, 90, 140), (140, 50, 40), (80, 100, 80)))
    _box(canvas, place, (*size, 1.3), angle_rad, colour)
    hollow = canvas.rectangle(place, (size[0] - 0.5, size[1] - 0.4), angle_rad)
    if not hollow.empty:
        fill = textured(
            canvas, hollow, pick(canvas, ((110, 100, 90), (70, 66, 62), (150, 140, 126))), 0.15, 0.2
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
    colours = ((120, 96, 72), (90, 88, 86), (190, 196, 198), (60, 62, 64), (150, 120, 90))
    canvas.paint(patch, textured(canvas, patch, pick(canvas, colours), 0.05, 0.06))
    if rng.random() < 0.4:
        for u_m in (-size[0] / 4, size[0] / 4):
            canvas.paint(
                canvas.rectangle(_on(place, angle_rad, u_m, 0.0), (0.6, size[1] * 0.7), angle_rad),
                reflectance((52, 58, 66)),
            )


def add_painted_box(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Paint or a plate on the ground with a car's proportions, seldom with two dark cross bands like glass."""
    rng = canvas.rng
    size = (float(rng.uniform(3.6, 5.2)), float(rng.uniform(1.6, 2.1)))
    patch = canvas.rectangle(place, size, angle_rad, float(rng.uniform(0, 0.5)))
    if patch.empty:
        return
    worn = np.clip(0.85 + 0.2 * canvas.noise("mottle", patch), 0.3, 1)
    canvas.paint(patch, pick(canvas, PAINT_COLOURS), worn)
    if rng.random() < 0.15:
        for u_m in (-0.3 * size[0], 0.2 * size[0]):
            canvas.paint(
                canvas.rectangle(_on(place, angle_rad, u_m, 0.0), (0.6, size[1] * 0.8), angle_rad),
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
        spot = _on(place, angle_rad, 1.3 * i - 2.0, float(rng.normal(0, 0.1)))
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
        spot = _on(place, angle_rad, 0.75 * i, 0.0)
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
        _box(canvas, _on(place, angle_rad, 0.0, v_m), (1.8, width, 0.6), angle_rad, wood)


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
                pick(canvas, ((50, 90, 140), (70, 100, 70), (150, 150, 150), (70, 66, 62))),
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
