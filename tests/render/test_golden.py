"""Small pictures of procedural vehicles, stored in `golden/`: a change of appearance must be meant.

After a meant change, look at the new pictures and store them:
SKYPROOF_WRITE_GOLDEN=1 python -m pytest tests/render/test_golden.py
"""

import dataclasses
import os
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from tests.render.bodies import PlainGround, scene, vehicles

GOLDEN = Path(__file__).parent / "golden"
# Noise does not compress; it has tests of its own.
SETTINGS = RenderSettings(noise=0.0)


@lru_cache
def van_and_car():
    settings = FleetSettings(count=2, weights={"van": 0.5, "saloon": 0.5})
    return sample_fleet(settings, generator=torch.Generator().manual_seed(3))


def one_box():
    return TorchRenderer(PlainGround(0.4), SETTINGS)(
        [scene((0.2, -0.1, 35.0), size_px=64)], vehicles(seed=1)
    )


def two_boxes_at_the_border():
    place = scene((-2.6, 2.2, 110.0), (2.8, -1.0, 10.0), size_px=64, sun_elevation_deg=30.0)
    return TorchRenderer(PlainGround(0.6), SETTINGS)([place], vehicles(2, seed=2))


def one_box_without_blur():
    sharp = dataclasses.replace(SETTINGS, blur_sigma_px=0.0)
    place = scene((0.0, 0.0, 80.0), tilt_deg=20.0, size_px=64)
    return TorchRenderer(PlainGround(0.3), sharp)([place], vehicles(seed=3))


def fleet_vehicles():
    place = scene((-2.0, -1.5, 60.0), (2.2, 1.0, 240.0), size_px=80)
    return TorchRenderer(PlainGround(0.45), SETTINGS)(
        [place], van_and_car().batch(van_and_car().ids)
    )


def fleet_vehicles_in_random_colours():
    place = scene((-2.0, -1.5, 60.0), (2.2, 1.0, 240.0), size_px=80)
    texture = UniversalTexture(
        CamouflageName.parse("R-U-0"), generator=torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        return TorchRenderer(PlainGround(0.45), SETTINGS)(
            [place], texture(van_and_car().batch(van_and_car().ids))
        )


PICTURES = [
    one_box,
    two_boxes_at_the_border,
    one_box_without_blur,
    fleet_vehicles,
    fleet_vehicles_in_random_colours,
]


@pytest.mark.parametrize("draw", PICTURES, ids=lambda draw: draw.__name__)
def test_the_picture_is_the_stored_one(draw):
    drawn = (draw().image[0] * 255).round().byte().permute(1, 2, 0).numpy()
    path = GOLDEN / f"{draw.__name__}.png"
    if os.environ.get("SKYPROOF_WRITE_GOLDEN") == "1":
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(drawn).save(path, optimize=True)
    with Image.open(path) as image:
        stored = np.array(image)
    assert stored.shape == drawn.shape
    difference = np.abs(stored.astype(int) - drawn.astype(int))
    assert difference.max() <= 2, (
        f"{(difference > 2).any(2).sum()} pixels differ, by up to {difference.max()}"
    )
