"""The procedural ground: every kind draws, light follows the sun, sizes the resolution."""

import math

import numpy as np
import pytest
import torch

from skyproof.geometry.colour import srgb_to_cielab
from skyproof.ground.canvas import Canvas
from skyproof.ground.clutter import CLUTTER
from skyproof.ground.kinds import draw_car_park
from skyproof.ground.procedural import GROUND_KINDS, GroundSensor, draw_ground, photograph, sunlight


def _flat_canvas(azimuth_rad):
    canvas = Canvas(160, 0.125, np.random.default_rng(0), axes_rad=0.0)
    canvas.reflectance[:] = 0.3
    canvas.sun_azimuth_rad, canvas.sun_elevation_rad = azimuth_rad, math.radians(45)
    return canvas


@pytest.mark.parametrize("kind", list(GROUND_KINDS))
def test_every_kind_draws(kind):
    canvas = Canvas(128, 0.125, np.random.default_rng(1), axes_rad=0.4)
    GROUND_KINDS[kind][0](canvas)
    assert np.isfinite(canvas.reflectance).all()
    assert np.isfinite(canvas.height).all()
    assert canvas.reflectance.max(2).min() > 0, "some ground was left undrawn"
    image, _, _ = photograph(canvas, GroundSensor.draw(canvas.rng))
    assert image.shape == (3, 128, 128)
    assert image.std() > 4
    assert np.abs(np.diff(image.astype(float), axis=2)).mean() > 0.5


@pytest.mark.parametrize("kind", list(CLUTTER))
def test_every_lookalike_changes_the_ground_about_its_place(kind):
    canvas = _flat_canvas(0.0)
    CLUTTER[kind](canvas, (0.0, 0.0), 0.3)
    changed = np.abs(canvas.reflectance - 0.3).max(2) > 0.02
    # Between a bin and a container: nothing is drawn elsewhere, and nothing is too small to see.
    assert 0.4 < changed.sum() * 0.125**2 < 60
    middle = canvas.pixels // 2
    assert changed[middle - 24 : middle + 24, middle - 24 : middle + 24].any()


def test_seeds_repeat_and_differ():
    first = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(1))
    again = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(1))
    other = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(2))
    assert torch.equal(first.image, again.image)
    assert not torch.equal(first.image, other.image)


@pytest.mark.parametrize(
    ("azimuth_deg", "shadow"), [(0, (0, -1)), (90, (1, 0)), (180, (0, 1)), (270, (-1, 0))]
)
def test_shadow_falls_away_from_the_sun(azimuth_deg, shadow):
    # A pole of 3 m in the middle; at 45 degrees its shadow is 3 m = 24 px long, on the far side
    # from the sun.
    canvas = _flat_canvas(math.radians(azimuth_deg))
    canvas.raise_to(canvas.rectangle((0.0, 0.0), (0.8, 0.8)), 3.0)
    light, _ = sunlight(canvas)
    middle = canvas.pixels // 2
    for distance, dark in ((16, True), (32, False), (-16, False)):
        value = light[middle + shadow[0] * distance, middle + shadow[1] * distance]
        assert (value < 0.1) == dark
    assert light[10, 10] == pytest.approx(math.sin(math.radians(45)), rel=1e-3)


def test_slope_towards_the_sun_is_brighter():
    canvas = _flat_canvas(0.0)
    roof = canvas.rectangle((0.0, 0.0), (10.0, 8.0), math.pi / 2)
    canvas.raise_to(roof, 4 - 0.5 * np.abs(roof.v))
    middle = canvas.pixels // 2
    light, _ = sunlight(canvas)
    assert light[middle, middle + 15] > 1.5 * light[middle, middle - 15]


def test_sizes_follow_the_resolution():
    # 4 m x 2 m cover 8 square metres whatever the pixel size and the angle.
    for gsd_m, angle in ((0.125, 0.0), (0.125, 0.5), (0.25, 1.1)):
        canvas = Canvas(100, gsd_m, np.random.default_rng(0), axes_rad=0.3)
        patch = canvas.rectangle((1.0, -0.5), (4.0, 2.0), angle)
        assert patch.coverage.sum() * gsd_m**2 == pytest.approx(8.0, rel=0.02)


def test_kinds_and_suns_vary():
    grounds = [
        draw_ground(16, 0.125, generator=torch.Generator().manual_seed(i)) for i in range(40)
    ]
    assert {ground.kind for ground in grounds} == set(GROUND_KINDS)
    assert sum(share for _, share in GROUND_KINDS.values()) == pytest.approx(1)
    assert len({round(ground.light.sun.azimuth_rad, 3) for ground in grounds}) == 40


def test_vehicles_may_stand_along_a_patch_where_it_lies():
    canvas = _flat_canvas(0.0)
    turned = Canvas(160, 0.125, np.random.default_rng(0), axes_rad=0.5)
    for axes_rad, own in ((0.0, canvas), (0.5, turned)):
        own.allow(own.rectangle((2.0, 1.0), (3.0, 1.0), 0.3))
        own.allow(own.rectangle((-4.0, -2.0), (2.0, 1.0)), turn_rad=math.pi / 2)
        directions = own.drivable()
        for place, heading in (((2.0, 1.0), 0.3), ((-4.0, -2.0), math.pi / 2)):
            column, row = (round(value) - own.margin_px for value in own.to_pixels(*place))
            found = math.radians(int(directions[row, column]) - 1)
            assert abs(math.sin(found - heading - axes_rad)) < math.radians(0.6)
        # 3 m x 1 m and 2 m x 1 m.
        assert (directions > 0).sum() * 0.125**2 == pytest.approx(5.0, rel=0.05)
        own.forbid(own.rectangle((2.0, 1.0), (5.0, 3.0), 0.3))
        assert (own.drivable() > 0).sum() * 0.125**2 == pytest.approx(2.0, rel=0.05)


def test_a_bending_road_is_followed():
    canvas = Canvas(320, 0.125, np.random.default_rng(2), axes_rad=0.2)
    ground = canvas.everywhere(wander_m=3.0)
    canvas.allow(canvas.band(ground, 0.0, 0.4))
    directions = canvas.drivable()
    rows, columns = np.nonzero(directions)
    assert np.ptp(directions[rows, columns].astype(int)) > 15, "it bends"
    for row, column in list(zip(rows, columns, strict=True))[::40]:
        heading = math.radians(int(directions[row, column]) - 1)
        # 1.5 m on along the heading the road's middle is still there.
        ahead = round(row - 12 * math.sin(heading)), round(column + 12 * math.cos(heading))
        if min(ahead) >= 1 and max(ahead) < 318:
            near = directions[ahead[0] - 1 : ahead[0] + 2, ahead[1] - 1 : ahead[1] + 2]
            assert near.any()


@pytest.mark.parametrize("kind", list(GROUND_KINDS))
def test_where_vehicles_may_stand_nothing_is_in_the_way(kind):
    places = 0
    for seed in range(3):
        canvas = Canvas(240, 0.125, np.random.default_rng(seed), axes_rad=0.4 + seed)
        GROUND_KINDS[kind][0](canvas)
        directions = canvas.drivable()
        rows, columns = np.nonzero(directions)
        chosen = np.random.default_rng(0).permutation(len(rows))[:60]
        places += len(chosen)
        u, v = np.meshgrid(np.linspace(-2.1, 2.1, 24), np.linspace(-0.8, 0.8, 10))
        for row, column in zip(rows[chosen], columns[chosen], strict=True):
            heading = math.radians(int(directions[row, column]) - 1)
            x = column + (math.cos(heading) * u - math.sin(heading) * v) / 0.125
            y = row - (math.sin(heading) * u + math.cos(heading) * v) / 0.125
            margin = canvas.margin_px
            under = canvas.height[(y + margin).astype(int), (x + margin).astype(int)]
            assert under.max() < 0.3, "a vehicle would stand in something"
    assert (places == 0) == (kind == "park")


def test_bays_of_a_car_park_are_between_its_lines():
    seen = 0
    for seed in range(6):
        canvas = Canvas(240, 0.125, np.random.default_rng(seed), axes_rad=0.3)
        draw_car_park(canvas)
        bright = canvas.reflectance.mean(2)
        directions = canvas.drivable()
        # Bays stand across the rows, slanted by up to 0.35 of their length.
        rows, columns = np.nonzero(directions)
        headings = np.radians(directions[rows, columns].astype(float) - 1)
        turns = headings - 0.3 - math.pi / 2
        bays = np.nonzero(np.abs(np.sin(turns)) < math.sin(math.atan(0.35) + 0.02))[0]
        # The mean brightness at so many metres to the left and right of all bays' middles.
        aside = np.linspace(-1.7, 1.7, 69)[:, None]
        x = columns[bays] - np.sin(headings[bays]) * aside / 0.125 + canvas.margin_px
        y = rows[bays] - np.cos(headings[bays]) * aside / 0.125 + canvas.margin_px
        profile = bright[y.astype(int), x.astype(int)].mean(1)
        line_m = [abs(float(aside[:34][profile[:34].argmax()][0]))]
        line_m.append(float(aside[35:][profile[35:].argmax()][0]))
        if min(profile[:34].max(), profile[35:].max()) > 1.2 * profile[34]:
            seen += 1
            # Lines are 2.3 to 2.7 m apart, nearer where bays are slanted, and each is read to a
            # pixel of 0.125 m.
            assert 2.0 < sum(line_m) < 2.9
            assert abs(line_m[0] - line_m[1]) < 0.45
    assert seen >= 4


def test_what_reaches_above_a_vehicle_covers_the_ground():
    canvas = _flat_canvas(0.0)
    canvas.raise_to(canvas.rectangle((-4.0, 0.0), (3.0, 3.0)), 3.0)
    canvas.raise_to(canvas.rectangle((4.0, 0.0), (3.0, 3.0)), 1.5)
    cover = canvas.cover(0.6)
    assert cover.shape == (160, 160)
    middle = 80
    assert cover[middle, middle - 32] == 255
    assert cover[middle, middle + 32] == 0
    # As blurred as the picture is.
    edge = cover[middle, middle - 32 + 8 : middle - 32 + 16]
    assert ((edge > 20) & (edge < 235)).any()
    assert (cover > 127).mean() == pytest.approx((3.0 / 20.0) ** 2, rel=0.1)
    drawn = draw_ground(128, 0.125, generator=torch.Generator().manual_seed(5))
    assert drawn.cover.shape == (128, 128)
    assert drawn.cover.dtype == np.uint8


def test_tones_are_as_wide_as_those_of_orthophotos():
    # Mean lightness and chroma of tiles; of orthophotos of a German town, a Belarusian suburb, a
    # Ugandan one, Brazilian grassland and Californian savanna 43, 46, 56, 52, 57 and 4, 5, 26, 10,
    # 12 were measured.
    found = []
    for seed in range(48):
        image = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(seed)).image
        cielab = srgb_to_cielab(image.float().flatten(1).T / 255)
        found.append((cielab[:, 0].mean().item(), cielab[:, 1:].norm(dim=1).mean().item()))
    lightness, chroma = np.array(found).T
    assert lightness.min() < 42 < 50 < lightness.max()
    assert chroma.min() < 4 < 16 < chroma.max()
