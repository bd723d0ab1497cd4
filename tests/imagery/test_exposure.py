"""Exposure, black and white balance, measured on ground whose light is known."""

import numpy as np
import pytest
import torch

from skyproof.errors import ImageryError
from skyproof.ground.ground import draw_ground_and_sun
from skyproof.imagery.exposure import measure_exposure


@pytest.fixture(scope="module")
def grounds():
    generator = torch.Generator().manual_seed(11)
    return [draw_ground_and_sun(300, 0.125, generator=generator) for _ in range(24)]


def test_white_is_measured_on_drawn_ground(grounds):
    found = np.array([np.mean(measure_exposure([each.image]).white) for each in grounds])
    true = np.array([np.mean(each.light.white) for each in grounds])
    errors = np.log(found / true)
    assert abs(np.median(errors)) < 0.15
    assert np.quantile(np.abs(errors), 0.75) < 0.35
    # Better than one white for all: a brighter exposure is seen as one.
    assert np.corrcoef(np.log(found), np.log(true))[0, 1] > 0.3


@pytest.mark.parametrize("tint", [(1.2, 1.0, 0.8), (0.85, 1.0, 1.15)])
def test_a_tinted_picture_has_a_tinted_white(grounds, tint):
    street = next(each for each in grounds if each.kind == "car park").image
    plain = np.array(measure_exposure([street]).white)
    linear = (street.double() / 255) ** 2.2 * torch.tensor(tint)[:, None, None] * 0.6
    tinted = (linear.clamp(0, 1) ** (1 / 2.2) * 255).round().byte()
    ratio = np.array(measure_exposure([tinted]).white) / plain
    expected = np.array(tint) / np.mean(tint)
    np.testing.assert_allclose(ratio / ratio.mean(), expected, rtol=0.12)


def test_haze_raises_the_black(grounds):
    image = grounds[0].image
    clear = np.array(measure_exposure([image]).black)
    hazy = np.array(measure_exposure([(image.float() * 0.7 + 76).round().byte()]).black)
    assert (hazy > clear + 0.02).all()


def test_imagery_of_one_colour_is_refused():
    with pytest.raises(ImageryError, match="one colour"):
        measure_exposure([torch.full((3, 400, 400), 90, dtype=torch.uint8)])
