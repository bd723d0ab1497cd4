"""The procedural ground: every kind draws, light follows the sun, sizes the resolution."""

import math

import numpy as np
import pytest
import torch

from skyproof.ground.canvas import Canvas, GroundSensor
from skyproof.ground.ground import GROUND_KINDS, KIND_SHARES, draw_ground, draw_ground_and_sun


def _flat_canvas(azimuth_rad):
    canvas = Canvas(160, 0.125, np.random.default_rng(0), axes_rad=0.0)
    canvas.reflectance[:] = 0.3
    canvas.sun_azimuth_rad, canvas.sun_elevation_rad = azimuth_rad, math.radians(45)
    return canvas


@pytest.mark.parametrize("kind", list(GROUND_KINDS))
def test_every_kind_draws(kind):
    canvas = Canvas(128, 0.125, np.random.default_rng(1), axes_rad=0.4)
    GROUND_KINDS[kind](canvas)
    assert np.isfinite(canvas.reflectance).all()
    assert np.isfinite(canvas.height).all()
    assert canvas.reflectance.max(2).min() > 0, "some ground was left undrawn"
    image = canvas.photograph(GroundSensor.draw(canvas.rng))
    assert image.shape == (3, 128, 128)
    assert image.std() > 4
    assert np.abs(np.diff(image.astype(float), axis=2)).mean() > 0.5


def test_seeds_repeat_and_differ():
    first = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(1))
    again = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(1))
    other = draw_ground(96, 0.125, generator=torch.Generator().manual_seed(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("azimuth_deg", "shadow"), [(0, (0, -1)), (90, (1, 0)), (180, (0, 1)), (270, (-1, 0))]
)
def test_shadow_falls_away_from_the_sun(azimuth_deg, shadow):
    # A pole of 3 m in the middle; at 45 degrees its shadow is 3 m = 24 px long, on the far side
    # from the sun.
    canvas = _flat_canvas(math.radians(azimuth_deg))
    canvas.raise_to(canvas.rectangle((0.0, 0.0), (0.8, 0.8)), 3.0)
    light = canvas._sunlight()
    middle = canvas.pixels // 2
    for distance, dark in ((16, True), (32, False), (-16, False)):
        value = light[middle + shadow[0] * distance, middle + shadow[1] * distance]
        assert (value < 0.1) == dark
    assert light[10, 10] == pytest.approx(math.sin(math.radians(45)), rel=1e-3)


def test_slope_towards_the_sun_is_brighter():
    canvas = _flat_canvas(0.0)
    roof = canvas.rectangle((0.0, 0.0), (10.0, 8.0), math.pi / 2)
    canvas.raise_to(roof, 4 - 0.5 * np.abs(roof.v))
    light, middle = canvas._sunlight(), canvas.pixels // 2
    assert light[middle, middle + 15] > 1.5 * light[middle, middle - 15]


def test_sizes_follow_the_resolution():
    # 4 m x 2 m cover 8 square metres whatever the pixel size and the angle.
    for gsd_m, angle in ((0.125, 0.0), (0.125, 0.5), (0.25, 1.1)):
        canvas = Canvas(100, gsd_m, np.random.default_rng(0), axes_rad=0.3)
        patch = canvas.rectangle((1.0, -0.5), (4.0, 2.0), angle)
        assert patch.coverage.sum() * gsd_m**2 == pytest.approx(8.0, rel=0.02)


def test_kinds_and_suns_vary():
    grounds = [
        draw_ground_and_sun(48, 0.125, generator=torch.Generator().manual_seed(i))
        for i in range(80)
    ]
    assert {ground.kind for ground in grounds} == set(GROUND_KINDS)
    assert sum(KIND_SHARES.values()) == pytest.approx(1)
    assert len({round(ground.sun_azimuth_rad, 3) for ground in grounds}) == 80
