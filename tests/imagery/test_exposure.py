"""Exposure, black and white balance, measured on ground whose light is known."""

import numpy as np
import pytest
import torch

from skyproof.errors import ImageryError
from skyproof.ground.procedural import draw_ground
from skyproof.imagery.photographs import ground_pixels, measure_exposure


def exposure(*images, vehicles_px=()):
    return measure_exposure(ground_pixels(one, vehicles_px, gsd_m=0.125) for one in images)


@pytest.fixture(scope="module")
def grounds():
    generator = torch.Generator().manual_seed(12)
    return [draw_ground(300, 0.125, generator=generator) for _ in range(24)]


def test_white_is_measured_on_drawn_ground(grounds):
    found = np.array([np.mean(exposure(each.image).white) for each in grounds])
    true = np.array([np.mean(each.light.white) for each in grounds])
    # A white that burns out is shown as the brightest value.
    errors = np.log(found.clip(max=1) / true.clip(max=1))
    assert abs(np.median(errors)) < 0.15
    assert np.quantile(np.abs(errors), 0.75) < 0.35
    # Better than one white for all: a brighter exposure is seen as one.
    assert np.corrcoef(np.log(found), np.log(true))[0, 1] > 0.3


@pytest.mark.parametrize("tint", [(1.1, 1.0, 0.9), (0.92, 1.0, 1.08)])
def test_a_tinted_picture_has_a_tinted_white(grounds, tint):
    def under(balance, image):
        linear = (image.double() / 255) ** 2.2 * torch.tensor(balance)[:, None, None] * 0.6
        return (linear.clamp(0, 1) ** (1 / 2.2) * 255).round().byte()

    # Tiles of one flight: each without the tint of its own, then all with the same one.
    own = [np.array(each.light.white) for each in grounds]
    plain = [1 / (white / white.mean()) for white in own]
    neutral = [under(each, one.image) for each, one in zip(plain, grounds, strict=True)]
    tinted = [under(each * tint, one.image) for each, one in zip(plain, grounds, strict=True)]
    ratio = np.array(exposure(*tinted).white) / np.array(exposure(*neutral).white)
    expected = np.array(tint) / np.mean(tint)
    np.testing.assert_allclose(ratio / ratio.mean(), expected, rtol=0.05)


def test_vehicles_are_not_taken_for_bright_ground(grounds):
    image = next(each for each in grounds if each.light.white[0] < 0.9).image.clone()
    bare = exposure(image).white
    # White roofs and glints of ten cars.
    middles = [(30.0 + 26 * i, 40.0 + 22 * i) for i in range(10)]
    for x, y in np.array(middles, int):
        image[:, y - 7 : y + 8, x - 16 : x + 17] = 250
    assert np.mean(exposure(image).white) > 1.2 * np.mean(bare)
    beside = exposure(image, vehicles_px=middles).white
    assert np.mean(beside) == pytest.approx(np.mean(bare), rel=0.1)


def test_white_burns_out_only_where_the_ground_does(grounds):
    """Cameras are exposed for the brightest of what they see."""
    bright = next(each for each in grounds if np.mean(each.light.white) > 1.2).image
    dimmed = (bright.float() * 0.94).byte()
    assert np.mean(exposure(dimmed).white) == pytest.approx(1, abs=0.001)
    clipped = (bright.float() * 1.3).clamp(max=255).byte()
    assert np.mean(exposure(clipped).white) > 1.2


def test_haze_raises_the_black(grounds):
    image = grounds[0].image
    clear = np.array(exposure(image).black)
    hazy = np.array(exposure((image.float() * 0.7 + 76).round().byte()).black)
    assert (hazy > clear + 0.02).all()


def test_imagery_of_one_colour_is_refused():
    with pytest.raises(ImageryError, match="one colour"):
        exposure(torch.full((3, 400, 400), 90, dtype=torch.uint8))
