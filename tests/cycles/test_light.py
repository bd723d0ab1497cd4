"""Light in Blender: how much, from where, and what paint does with it."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from skyproof.cycles.settings import CyclesSettings
from skyproof.scenes.scene import Sun
from skyproof.scenes.weather import Weather
from skyproof.vehicles.vehicle import Overlay, Part
from tests.cycles.stage import body, matt, one_job, white_sheet, world_places
from tests.render.bodies import rounded_box, scene, vehicles

pytestmark = pytest.mark.blender

MANY = CyclesSettings(samples=256)


def under(azimuth_deg, elevation_deg, overcast=0.0):
    place = dataclasses.replace(
        scene((0, 0, 0), tilt_deg=0.0),
        sun=Sun(math.radians(azimuth_deg), math.radians(elevation_deg)),
    )
    return (
        dataclasses.replace(place, weather=Weather("overcast", overcast=overcast))
        if overcast
        else place
    )


@pytest.mark.parametrize("overcast", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("elevation_deg", [12, 65])
def test_a_white_matt_level_surface_sends_1(workers, elevation_deg, overcast):
    job = matt(
        one_job(
            under(200, elevation_deg, overcast),
            white_sheet(1.5, 0.05),
            settings=MANY,
            margin_m=0.25,
        )
    )
    (result,) = workers.run([job])
    whole = result[result[..., 3] == 1]
    assert len(whole) > 80
    assert whole[:, :3].mean(0).tolist() == pytest.approx([1.0, 1.0, 1.0], abs=0.02)


@pytest.mark.parametrize(
    ("column", "towards"), [(16, (0, 1)), (32, (1, 0)), (48, (0, -1)), (0, (-1, 0))]
)
def test_a_bright_patch_of_sky_casts_shadows_away_from_it(workers, column, towards):
    """The middle column of the map looks along +x, columns go clockwise, row 0 is the zenith."""
    job = one_job(
        under(0, 45), body(0.6, 0.6, 1.5), settings=CyclesSettings(samples=64), margin_m=1.0
    )
    sky = np.zeros_like(job.arrays["sky"])
    sky[5:11, [(column + step) % 64 for step in range(-4, 4)]] = 10.0
    numbers = {**job.numbers, "sun_irradiance": [0.0, 0.0, 0.0]}
    (result,) = workers.run(
        [dataclasses.replace(job, numbers=numbers, arrays={**job.arrays, "sky": sky})]
    )
    x, y = world_places(job)
    along, across = x * towards[0] + y * towards[1], x * towards[1] + y * towards[0]
    near = (np.abs(across) < 0.2) & (np.abs(along) > 0.4) & (np.abs(along) < 0.9)
    ratio = result[..., 4:].mean(-1)
    assert ratio[near & (along < 0)].mean() < 0.4
    assert ratio[near & (along > 0)].mean() > 0.9


def test_without_any_light_there_is_none(workers):
    job = one_job(
        under(0, 45), body(0.6, 0.6, 1.5), settings=CyclesSettings(samples=1), margin_m=0.25
    )
    dark = {**job.arrays, "sky": np.zeros_like(job.arrays["sky"])}
    numbers = {**job.numbers, "sun_irradiance": [0.0, 0.0, 0.0]}
    (result,) = workers.run([dataclasses.replace(job, numbers=numbers, arrays=dark)])
    assert not result[..., :3].any()
    assert result[..., 3].max() == 1


def test_red_paint_lights_the_ground_beside_its_sunlit_side(workers):
    job = one_job(
        under(0, 30), body(2.0, 2.0, 1.5, (1.0, 0.0, 0.0)), settings=CyclesSettings(samples=64)
    )
    (result,) = workers.run([job])
    x, y = world_places(job)
    beside = result[(x > 1.05) & (x < 1.6) & (np.abs(y) < 0.8)][:, 4:]
    red, green, blue = beside.mean(0)
    assert red > 1.02
    # The body hides sky: what it takes is not given back in the other colours.
    assert green < red - 0.05
    assert blue < red - 0.05


def test_photograph_below_lights_the_body_from_below(workers):
    """A vertical side under a high sun takes most light from the ground, in the ground's colour."""
    shown = {}
    for name, colour in (("red", (0.8, 0.0, 0.0)), ("blue", (0.0, 0.0, 0.8))):
        place = dataclasses.replace(
            under(180, 60), camera=dataclasses.replace(scene().camera, azimuth_rad=0.0)
        )
        ground = torch.tensor(colour)[:, None, None]
        job = matt(
            one_job(place, body(1.5, 1.5, 1.5), ground=ground, settings=CyclesSettings(samples=32))
        )
        (result,) = workers.run([job])
        shown[name] = result[result[..., 3] == 1][:, :3].mean(0)
    assert shown["red"][0] > shown["blue"][0] * 1.02
    assert shown["blue"][2] > shown["red"][2] * 1.02


def test_finish_changes_what_a_camouflage_covers_and_nothing_else(workers):
    """The front half wears a camouflage, the rear half is glass."""
    batch = dataclasses.replace(vehicles(), vertices=rounded_box(3.0, 1.5, 1.2))
    front = torch.zeros(1, 512, 512, dtype=torch.bool)
    front[:, :256] = True
    parts = torch.full((1, 512, 512), int(Part.GLASS), dtype=torch.uint8)
    batch = dataclasses.replace(
        batch, parts=parts, overlay=Overlay(torch.full((3, 512, 512), 0.3), front)
    )
    jobs = [
        one_job(
            under(45, 50), batch, settings=CyclesSettings(samples=16, finish=finish), margin_m=0.25
        )
        for finish in ("gloss", "matt")
    ]
    gloss, other = workers.run(jobs)
    x, _ = world_places(jobs[0])
    difference, whole = np.abs(gloss - other)[..., :3].max(-1), gloss[..., 3] == 1
    ahead, behind = difference[whole & (x > 0.2)], difference[whole & (x < -0.2)]
    assert np.median(ahead) > 0.002
    # Light that went by way of the ground and the other half.
    assert behind.mean() < 0.02 * ahead.mean()
