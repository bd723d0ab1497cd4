"""Sun and sky in numbers, without Blender."""

import math

import numpy as np
import pytest
import torch

from skyproof.cycles.jobs import daylight
from skyproof.render.lighting import sky_light
from skyproof.render.materials import CAMOUFLAGE, material_labels, material_table
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Sun
from skyproof.vehicles.vehicle import Overlay, Part
from tests.render.bodies import vehicles

ROWS, COLUMNS = 900, 1440


def directions():
    """A fine grid over the sphere: elevation and azimuth in radians, and solid angle."""
    elevation = (np.arange(ROWS) + 0.5) / ROWS * np.pi - np.pi / 2
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
    elevation, azimuth = np.meshgrid(elevation, azimuth, indexing="ij")
    return elevation, azimuth, np.cos(elevation) * (np.pi / ROWS) * (2 * np.pi / COLUMNS)


def look(sky, elevation, azimuth):
    """Returns radiance in a direction: row 0 at the zenith, the middle column along +x."""
    rows, columns, _ = sky.shape
    row = ((np.pi / 2 - elevation) / np.pi * rows).astype(int).clip(0, rows - 1)
    column = np.floor((0.5 - azimuth / (2 * np.pi)) * columns).astype(int) % columns
    return sky[row, column]


@pytest.mark.parametrize("overcast", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("elevation_deg", [10, 35, 80])
def test_sun_and_sky_add_up_to_pi_on_level_ground(elevation_deg, overcast):
    sun = Sun(math.radians(130), math.radians(elevation_deg))
    irradiance, sky = daylight(sun, *sky_light(Light(), overcast))
    elevation, azimuth, solid_angle = directions()
    received = np.maximum(np.sin(elevation), 0) * solid_angle
    diffuse = (look(sky, elevation, azimuth) * received[..., None]).sum((0, 1))
    direct = np.array(irradiance) * math.sin(sun.elevation_rad)
    assert (diffuse + direct).tolist() == pytest.approx([math.pi] * 3, rel=5e-3)
    # The sky's share of the light, by luminance.
    luminance = np.array([0.2126, 0.7152, 0.0722])
    assert diffuse @ luminance / math.pi == pytest.approx(
        overcast + (1 - overcast) * 0.25, rel=0.02
    )


@pytest.mark.parametrize("overcast", [0.0, 1.0])
def test_nothing_shines_below_the_horizon(overcast):
    _, sky = daylight(Sun(0.3, 0.7), *sky_light(Light(), overcast))
    elevation, azimuth, _ = directions()
    seen = look(sky, elevation, azimuth)
    assert not seen[elevation < 0].any()
    assert (seen[elevation > 0] > 0).all()


@pytest.mark.parametrize("azimuth_deg", [0, 77, 180, 290])
def test_a_clear_sky_is_brightest_near_the_sun_and_bluer_than_sunlight(azimuth_deg):
    sun = Sun(math.radians(azimuth_deg), math.radians(40))
    irradiance, sky = daylight(sun, *sky_light(Light(), 0.0))
    elevation, azimuth, _ = directions()
    brightness = look(sky, elevation, azimuth).sum(-1)
    # The map's cells are 5.6 degrees wide; nearer to the horizon the sky itself is brighter.
    brightest = brightness == brightness.max()
    assert math.degrees(elevation[brightest].mean()) == pytest.approx(40, abs=6)
    turn = (np.degrees(azimuth[brightest]) - azimuth_deg + 180) % 360 - 180
    assert abs(turn.mean()) < 3
    colour = look(sky, elevation, azimuth).sum((0, 1))
    assert colour[2] / colour[0] > 1.2 * irradiance[2] / irradiance[0]


def test_an_overcast_sky_hides_the_sun_and_is_grey_and_brightest_overhead():
    irradiance, sky = daylight(Sun(1.0, 0.5), *sky_light(Light(), 1.0))
    assert irradiance == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(sky[..., 0], sky[..., 2], rtol=1e-6)
    # CIE 15469, type 1: (1 + 4 exp(-0.7 / cos Z)) is about 3 times as bright overhead as at the
    # horizon.
    zenith, horizon = sky[0, 0, 0], sky[15, :, 0].mean()
    assert zenith / horizon == pytest.approx(1 + 4 * math.exp(-0.7), rel=0.02)
    np.testing.assert_allclose(sky, np.broadcast_to(sky[:, :1], sky.shape), rtol=1e-5)


def test_paint_is_what_a_camouflage_covers_and_parts_are_what_they_are_elsewhere():
    batch = vehicles()
    parts = torch.full_like(batch.parts, int(Part.GLASS))
    mask = torch.zeros(1, 512, 512, dtype=torch.bool)
    mask[:, :100] = True
    bare = type(batch)(batch.template, batch.vertices, batch.texture, parts, batch.ids)
    covered = type(batch)(
        batch.template,
        batch.vertices,
        batch.texture,
        parts,
        batch.ids,
        Overlay(torch.rand(3, 512, 512), mask),
    )
    repainted = type(batch)(
        batch.template, batch.vertices, batch.texture, parts, batch.ids, None, True
    )
    assert torch.equal(material_labels(bare), parts)
    labels = material_labels(covered)
    assert (labels[mask] == CAMOUFLAGE).all()
    assert (labels[~mask] == Part.GLASS).all()
    assert (material_labels(repainted) == CAMOUFLAGE).all()


def test_the_finish_is_of_camouflage_alone():
    gloss, matt = material_table("gloss"), material_table("matt")
    assert len(gloss) == len(Part) + 1
    assert torch.equal(gloss[:CAMOUFLAGE], matt[:CAMOUFLAGE])
    # Gloss is the clear coat of the vehicle's own paint, matt has none.
    assert torch.equal(gloss[CAMOUFLAGE], gloss[Part.BODY])
    assert gloss[CAMOUFLAGE, 1] > 0
    assert matt[CAMOUFLAGE, 1] == 0
    assert ((gloss >= 0) & (gloss <= 1)).all()
