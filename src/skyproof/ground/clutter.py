"""Small things of the procedural ground, many of about a car's size, and its plants."""

import math
from collections.abc import Callable

import numpy as np

from skyproof.ground.canvas import Array, Canvas, Patch, Place, beside, palette, reflectance
from skyproof.vehicles.paints import PAINT_SHARES, PAINT_TONES

_CONDITIONERS = palette("bec0c0 96989a ecece8")
_RUBBLE = palette("6e645a 5e5852 968c7e")
_SHEDS = palette("786048 5a5856 bec4c6 686a6c 96785a")
_SURROUNDS = palette("c8c0b2 aaa094")
_WATERS = palette("5aaabe 468caa 3c6464")
_PALLETS = palette("aa8c64 8c765a c8ccce 3c3e42")
_BINS = palette("3c4c3c 34383e 5a4a38 3c5078")
_BENCHES = palette("96785a 6e645c")
_GIRDERS = palette("b01c3c c87828 e4e4dc d8d8d0 b8bcb8 7c3028")


def add_lamp_post(canvas: Canvas, place: Place) -> None:
    """Adds a thin post, of which one sees little but its long shadow."""
    post = canvas.disc(place, 0.14)
    canvas.raise_to(post, canvas.rng.uniform(4, 8))
    canvas.paint(post, reflectance((190, 190, 186)))


def add_manhole(canvas: Canvas, place: Place) -> None:
    """Adds a round or square cover in the road."""
    side_m = canvas.rng.uniform(0.5, 0.8)
    is_round = canvas.rng.random() < 0.6
    patch = canvas.disc(place, side_m / 2) if is_round else canvas.rectangle(place, (side_m,) * 2)
    canvas.shade(patch, canvas.rng.uniform(0.55, 0.8))


def _painted(canvas: Canvas) -> Array:
    """Draws the reflectance of a vehicle's paint, a little off."""
    # Things of a car's size have each vehicle paint as often as vehicles do, because a detector
    # would treat a colour that only one of the two has as evidence.
    name = canvas.rng.choice(list(PAINT_SHARES), p=list(PAINT_SHARES.values()))
    return canvas.pick(
        [tuple(round(255 * channel) for channel in tone) for tone in PAINT_TONES[name]]
    )


def _box(
    canvas: Canvas, place: Place, size_m: tuple[float, float, float], angle_rad: float, tone: Array
) -> Patch:
    """Puts a plain box of length, width and height on whatever is there."""
    patch = canvas.rectangle(place, size_m[:2], angle_rad)
    if not patch.empty:
        canvas.raise_to(patch, canvas.base_height(place) + size_m[2])
        canvas.paint(patch, canvas.varied(patch, tone, grain=0.04, mottle=0.05))
    return patch


def add_air_conditioner(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a pale box with dark fans."""
    length_m, width_m = canvas.rng.uniform(1.0, 3.2), canvas.rng.uniform(0.9, 1.6)
    fan_m = canvas.either(0.17, 0.33)
    _box(canvas, place, (length_m, width_m, 0.9), angle_rad, canvas.pick(_CONDITIONERS))
    for u_m in np.arange(-length_m / 2 + 0.55, length_m / 2 - 0.4, 3 * fan_m).tolist():
        fan = canvas.disc(beside(place, angle_rad, u_m, 0.0), fan_m)
        canvas.paint(fan, reflectance((62, 64, 66)))


def add_container(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a shipping container, half or full length, with its ribs."""
    length_m = canvas.either(3.0, 6.06, 6.06, 12.2)
    patch = _box(canvas, place, (length_m, 2.44, 2.6), angle_rad, _painted(canvas))
    canvas.shade(patch, 1 + 0.1 * np.sin(2 * math.pi * patch.u / 0.55))


def add_skip(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds an open skip: a bright rim, sloping dark walls, rubble."""
    size_m = (canvas.rng.uniform(3.0, 4.6), canvas.rng.uniform(1.6, 2.0))
    _box(canvas, place, (*size_m, 1.3), angle_rad, _painted(canvas))
    hollow = canvas.rectangle(place, (size_m[0] - 0.5, size_m[1] - 0.4), angle_rad)
    if not hollow.empty:
        fill = canvas.varied(hollow, canvas.pick(_RUBBLE), grain=0.15, mottle=0.2)
        canvas.paint(hollow, fill * np.exp(0.3 * canvas.noise("clump", hollow))[..., None])


def add_shed(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a garden shed or greenhouse with a small ridge, of about a car's outline."""
    size_m = (canvas.rng.uniform(2.2, 5.2), canvas.rng.uniform(1.6, 2.6))
    patch = canvas.rectangle(place, size_m, angle_rad)
    if patch.empty:
        return
    canvas.raise_to(patch, 2.0 + 0.35 * (size_m[1] / 2 - np.abs(patch.v)))
    canvas.paint(patch, canvas.varied(patch, canvas.pick(_SHEDS), grain=0.05, mottle=0.06))
    if canvas.rng.random() < 0.4:
        for u_m in (-size_m[0] / 4, size_m[0] / 4):
            window = beside(place, angle_rad, u_m, 0.0)
            glass = reflectance((52, 58, 66))
            canvas.paint(canvas.rectangle(window, (0.6, size_m[1] * 0.7), angle_rad), glass)


def add_painted_box(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds paint or a plate of a car's proportions, seldom with two dark cross bands like glass."""
    size_m = (canvas.rng.uniform(3.6, 5.2), canvas.rng.uniform(1.6, 2.1))
    patch = canvas.rectangle(place, size_m, angle_rad, canvas.rng.uniform(0, 0.5))
    if patch.empty:
        return
    worn = np.clip(0.85 + 0.2 * canvas.noise("mottle", patch), 0.3, 1)
    canvas.paint(patch, _painted(canvas), worn)
    if canvas.rng.random() < 0.15:
        for u_m in (-0.3 * size_m[0], 0.2 * size_m[0]):
            pane = beside(place, angle_rad, u_m, 0.0)
            glass = reflectance((50, 52, 56))
            canvas.paint(canvas.rectangle(pane, (0.6, size_m[1] * 0.8), angle_rad), glass, 0.8)


def add_pool(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a garden pool with its pale surround."""
    size_m = (canvas.rng.uniform(3.5, 9), canvas.rng.uniform(2.5, 4.5))
    around_m = (size_m[0] + 1.6, size_m[1] + 1.6)
    canvas.paint(canvas.rectangle(place, around_m, angle_rad), canvas.pick(_SURROUNDS))
    water = canvas.rectangle(place, size_m, angle_rad, canvas.rng.uniform(0, 1.2))
    if not water.empty:
        canvas.paint(water, canvas.varied(water, canvas.pick(_WATERS), grain=0.05, mottle=0.08))


def add_kiosk(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a booth as small as a car; one end or the border of its roof has another colour."""
    size_m = (canvas.rng.uniform(2.2, 4.8), canvas.rng.uniform(1.7, 2.6))
    height_m = canvas.rng.uniform(2.2, 3.0)
    _box(canvas, place, (*size_m, height_m), angle_rad, _painted(canvas))
    band_m = canvas.rng.uniform(0.3, 1.2)
    if canvas.rng.random() < 0.5:
        middle = (size_m[0] - band_m, size_m[1] - min(band_m, 0.8))
        _box(canvas, place, (*middle, height_m), angle_rad, _painted(canvas))
    else:
        end = beside(place, angle_rad, (size_m[0] - band_m) / 2, 0.0)
        _box(canvas, end, (band_m, size_m[1], height_m), angle_rad, _painted(canvas))


def add_stairs(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds stairs that lead below the ground: fine steps between parapets, signs at their end."""
    rng = canvas.rng
    length_m, width_m, wall_m = rng.uniform(6, 11.5), rng.uniform(3.0, 4.8), rng.uniform(0.3, 0.5)
    tone = canvas.pick((*_SURROUNDS, (156, 80, 72)))
    canvas.forbid(_box(canvas, place, (length_m, width_m, 1.0), angle_rad, tone))
    # The upper end has no parapet.
    middle = beside(place, angle_rad, -wall_m / 2, 0.0)
    shaft = canvas.rectangle(middle, (length_m - wall_m, width_m - 2 * wall_m), angle_rad)
    down = np.clip(0.5 + shaft.u / length_m, 0, 1)
    depth = canvas.height[shaft.rows, shaft.columns]
    np.copyto(depth, rng.uniform(-3.5, -1.0) * down, where=shaft.inside > 0)
    landing = np.abs(shaft.u - rng.uniform(-0.4, 0.4) * length_m) < rng.uniform(0, 1.2)
    steps = np.where((np.mod(shaft.u, 0.36) < 0.14) & ~landing, 0.45, 1.0)
    tone = canvas.pick(_CONDITIONERS) * rng.uniform(0.5, 0.9)
    canvas.paint(shaft, tone * (steps * (1 - rng.uniform(0.2, 0.9) * down**2))[..., None])
    if rng.random() < 0.6:
        _box(canvas, place, (length_m - 2, 0.15, 1.5), angle_rad, canvas.pick(_CONDITIONERS))
    for v_m in np.arange(0.4, width_m * rng.uniform(0, 1), 0.6).tolist():
        spot = beside(place, angle_rad, length_m / 2 + rng.uniform(-0.1, 0.2), v_m - width_m / 2)
        _box(canvas, spot, (0.4, rng.uniform(0.4, 0.6), 0.8), angle_rad, canvas.pick(_GIRDERS))


def add_girders(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds girders side by side over dark gaps, as on building sites and in tram depots."""
    rng = canvas.rng
    count, pitch_m, length_m = rng.integers(4, 10), rng.uniform(0.5, 0.8), rng.uniform(4, 8)
    canvas.shade(canvas.rectangle(place, (0.9 * length_m, count * pitch_m), angle_rad), 0.25)
    tones = [canvas.pick(_GIRDERS) for _ in range(3)]
    for i in range(count):
        spot = beside(place, angle_rad, rng.normal(0, 0.3), (i - (count - 1) / 2) * pitch_m)
        size_m = (length_m * rng.uniform(0.7, 1), rng.uniform(0.2, 0.4), rng.uniform(0.4, 1.2))
        _box(canvas, spot, size_m, angle_rad + rng.normal(0, 0.03), canvas.either(*tones))


def add_rubble(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a heap of pale and dark lumps."""
    size_m = (canvas.rng.uniform(1.5, 5), canvas.rng.uniform(1.0, 2.5))
    heap = canvas.rectangle(place, size_m, angle_rad, 0.5)
    if not heap.empty:
        lumps = canvas.noise("clump", heap)
        tone = canvas.pick((*_RUBBLE, *_SURROUNDS))
        canvas.raise_to(heap, np.clip(0.4 + 0.3 * lumps, 0, 1.2))
        canvas.paint(heap, tone * np.exp(0.6 * lumps)[..., None], np.clip(0.8 + 0.5 * lumps, 0, 1))


def add_pallets(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds stacks of pallets or wrapped goods, side by side."""
    rng = canvas.rng
    wood = canvas.pick(_PALLETS)
    for i in range(rng.integers(1, 5)):
        spot = beside(place, angle_rad, 1.3 * i - 2.0, rng.normal(0, 0.1))
        size_m = (1.2, 1.0, rng.uniform(0.3, 1.8))
        patch = _box(canvas, spot, size_m, angle_rad, wood * rng.uniform(0.8, 1.2))
        canvas.shade(patch, np.where(np.mod(patch.v, 0.28) < 0.1, 0.7, 1.0))


def add_bins(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds one to four wheeled bins in a row."""
    for i in range(canvas.rng.integers(1, 5)):
        size_m = (0.6, canvas.rng.uniform(0.7, 1.2), 1.1)
        spot = beside(place, angle_rad, 0.75 * i, 0.0)
        _box(canvas, spot, size_m, angle_rad, canvas.pick(_BINS))


def add_bench(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a table with its two benches."""
    wood = canvas.pick(_BENCHES)
    for v_m, width_m in ((0.0, 0.7), (0.75, 0.3), (-0.75, 0.3)):
        _box(canvas, beside(place, angle_rad, 0.0, v_m), (1.8, width_m, 0.6), angle_rad, wood)


def add_tarpaulin(canvas: Canvas, place: Place, angle_rad: float) -> None:
    """Adds a covered heap about as large as a car: soft outline, smooth top."""
    size_m = (canvas.rng.uniform(2.5, 5), canvas.rng.uniform(1.6, 2.4))
    patch = canvas.rectangle(place, size_m, angle_rad, 0.6)
    if not patch.empty:
        rise_m = 1.1 * np.sqrt(np.clip(patch.inside, 0, 1)) + 0.1 * canvas.noise("clump", patch)
        canvas.raise_to(patch, 0.3 + np.clip(rise_m, 0, 1.6))
        canvas.paint(patch, canvas.varied(patch, _painted(canvas), grain=0.03, mottle=0.1))


CLUTTER: dict[str, Callable[[Canvas, Place, float], None]] = {
    "air conditioner": add_air_conditioner,
    "bench": add_bench,
    "bins": add_bins,
    "container": add_container,
    "girders": add_girders,
    "kiosk": add_kiosk,
    "painted box": add_painted_box,
    "pallets": add_pallets,
    "pool": add_pool,
    "rubble": add_rubble,
    "shed": add_shed,
    "skip": add_skip,
    "stairs": add_stairs,
    "tarpaulin": add_tarpaulin,
}
"""Things that a poor detector mistakes for cars."""


def add_clutter(canvas: Canvas, place: Place, angle_rad: float, *kinds: str) -> None:
    """Adds one thing of the named kinds, mostly in line with `angle_rad` and sometimes askew."""
    rng = canvas.rng
    askew_rad = rng.normal(0, 0.05) if rng.random() < 0.7 else rng.uniform(0, math.pi)
    CLUTTER[kinds[rng.integers(len(kinds))]](canvas, place, angle_rad + askew_rad)


CROWN_COLOURS = palette("465c30 3a5232 586636 60603a 32462e 70763e 263428 3e3436")


def add_stand(canvas: Canvas, place: Place, reach_m: float) -> None:
    """Plants trees so close together that their crowns touch, most of them of one kind.

    Some dark gaps are left between them, as large and as black as a vehicle.
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
    # Blossom, stones or litter lie beside some.
    for _ in range(canvas.either(0, 0, 0, 0, 0, 0, 4, 9)):
        u_m, v_m = radius_m * canvas.rng.normal((0.8, 0.0), 0.35)
        speck = canvas.disc((place[0] + u_m, place[1] + v_m), canvas.rng.uniform(0.1, 0.3), 0.4)
        canvas.paint(speck, reflectance((240, 240, 234)))


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
