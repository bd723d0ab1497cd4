"""Crops laid over a photograph, worked out by hand."""

import math

import pytest
import torch

from skyproof.cycles import renderer
from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.lighting import scene_lights
from skyproof.scenes.light import Light
from skyproof.scenes.sensor import Sensor
from tests.render.bodies import scene

SHARP = Sensor(blur_sigma_px=0.0, noise=0.0)
SIZE = 40
CLEAR_DAY = Light()


def plain(light=0.5):
    return linear_to_srgb(torch.full((3, SIZE, SIZE), light))


def layers(width, height, colour=(0.0, 0.0, 0.0), alpha=0.0, ratio=(1.0, 1.0, 1.0)):
    """Colour times coverage, coverage, ratio; the same everywhere."""
    values = torch.tensor([*(alpha * each for each in colour), alpha, *ratio])
    return values[:, None, None].expand(7, height, width).clone()


def shown_by(own):
    """How one photograph shows light."""
    return scene_lights([own], [scene((0.0, 0.0, 0.0))], torch.zeros(1))


def composite_crops(photograph, crops, seed, margin_px, sensor, own=CLEAR_DAY):
    return renderer.composite_crops(photograph, crops, seed, margin_px, sensor, shown_by(own))


def light(image):
    return srgb_to_linear(image)


def test_shaded_ground_keeps_its_ratio_of_the_light_and_the_rest_its_bytes():
    photograph = plain()
    crop = layers(20, 16, ratio=(0.25, 0.5, 1.0))
    image = composite_crops(photograph, [((8, 12, 20, 16), crop)], 0, 4, SHARP)
    # Rows 12 to 27, columns 8 to 27; beyond the margin of 4 the ratio counts whole.
    middle = light(image)[:, 16:24, 12:24]
    for channel, expected in enumerate((0.125, 0.25, 0.5)):
        torch.testing.assert_close(
            middle[channel], torch.full((8, 12), expected), atol=1e-5, rtol=0
        )
    outside = torch.ones(SIZE, SIZE, dtype=torch.bool)
    outside[12:28, 8:28] = False
    assert torch.equal(image[:, outside], photograph[:, outside])


def test_the_ratio_fades_out_towards_the_crops_edge():
    image = composite_crops(
        plain(), [((8, 12, 20, 16), layers(20, 16, ratio=(0.2, 0.2, 0.2)))], 0, 4, SHARP
    )
    row = light(image)[0, 20]
    # Pixel centres lie 0.5, 1.5, ... from the edge: 1/8, 3/8, 5/8, 7/8 of the margin.
    for step in range(4):
        expected = 0.5 * (1 - 0.8 * (2 * step + 1) / 8)
        assert float(row[8 + step]) == pytest.approx(expected, abs=1e-5)
        assert float(row[27 - step]) == pytest.approx(expected, abs=1e-5)
    assert float(row[7]) == pytest.approx(0.5, abs=1e-6)
    assert float(row[28]) == pytest.approx(0.5, abs=1e-6)
    # At a corner both fades count.
    assert float(light(image)[0, 12, 8]) == pytest.approx(0.5 * (1 - 0.8 / 64), abs=1e-5)


def test_the_ratio_stays_whole_where_the_image_cuts_the_crop():
    blurred = Sensor(blur_sigma_px=0.5, noise=0.0)
    radius = blurred.blur_radius_px
    shade = (0.2, 0.2, 0.2)
    # From beyond the left border to the middle, and from there to beyond the lower right corner.
    left = ((-radius, 8, 20 + radius, 20), layers(20 + radius, 20, ratio=shade))
    corner = ((24, 24, 16 + radius, 16 + radius), layers(16 + radius, 16 + radius, ratio=shade))
    row = light(composite_crops(plain(), [left], 0, 4, blurred))[0, 18]
    torch.testing.assert_close(row[:14], torch.full((14,), 0.1), atol=1e-5, rtol=0)
    assert float(row[17]) > 0.15
    image = light(composite_crops(plain(), [corner], 0, 4, blurred))[0]
    torch.testing.assert_close(image[30:, 30:], torch.full((10, 10), 0.1), atol=1e-5, rtol=0)
    assert float(image[30, 25]) > 0.15


def test_a_body_hides_the_ground_by_its_coverage_up_to_the_crops_edge():
    colour = (0.3, 0.1, 0.7)
    crop = layers(10, 10, colour, alpha=1.0, ratio=(0.0, 0.0, 0.0))
    crop[:, :, 5:] = layers(5, 10, colour, alpha=0.4, ratio=(0.5, 0.5, 0.5))
    image = light(composite_crops(plain(), [((20, 4, 10, 10), crop)], 0, 1, SHARP))
    for channel, value in enumerate(colour):
        assert float(image[channel, 4, 20]) == pytest.approx(value, abs=1e-5)
        assert float(image[channel, 8, 22]) == pytest.approx(value, abs=1e-5)
        # Four tenths of the body; the rest is ground in half its light.
        assert float(image[channel, 8, 27]) == pytest.approx(
            0.4 * value + 0.6 * 0.5 * 0.5, abs=1e-5
        )


def test_ground_beside_a_bright_side_gets_brighter():
    image = light(
        composite_crops(
            plain(), [((5, 5, 20, 20), layers(20, 20, ratio=(1.4, 1.0, 1.0)))], 0, 2, SHARP
        )
    )
    assert image[:, 15, 15].tolist() == pytest.approx([0.7, 0.5, 0.5], abs=1e-5)


def test_crops_that_overlap_are_not_counted_twice():
    generator = torch.Generator().manual_seed(1)
    whole = torch.rand(7, 20, 30, generator=generator)
    whole[:3] *= whole[3:4]
    single = composite_crops(plain(), [((4, 6, 30, 20), whole)], 0, 2, SHARP)
    parts = [((4, 6, 18, 20), whole[:, :, :18]), ((14, 6, 20, 20), whole[:, :, 10:])]
    twice = composite_crops(plain(), parts, 0, 2, SHARP)
    torch.testing.assert_close(twice, single, atol=1e-5, rtol=0)
    assert torch.equal(twice, composite_crops(plain(), parts, 0, 2, SHARP))


def test_where_two_crops_differ_the_one_seen_from_farther_inside_counts_more():
    dark, bright = layers(10, 10, ratio=(0.0, 0.0, 0.0)), layers(10, 10)
    image = light(
        composite_crops(plain(), [((5, 5, 10, 10), dark), ((13, 5, 10, 10), bright)], 0, 4, SHARP)
    )[0, 10]
    # Column 13 is 1.5 from the dark crop's edge and 0.5 from the bright one's: trust 3/8 and 1/8.
    assert float(image[13]) == pytest.approx(0.5 * (1 - 0.375 / 0.5 * 0.375), abs=2e-3)


def test_without_crops_the_picture_is_the_photograph():
    photograph = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    assert torch.equal(composite_crops(photograph, [], 0, 4, Sensor(2.4)), photograph)
    undisturbed = [((4, 4, 20, 20), layers(20, 20))]
    assert torch.equal(composite_crops(photograph, undisturbed, 0, 4, Sensor(2.4)), photograph)


def test_beyond_crop_and_blur_the_photographs_bytes_stay():
    sensor = Sensor(2.4)
    photograph = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    crop = layers(8, 6, (0.9, 0.1, 0.1), alpha=1.0)
    image = composite_crops(photograph, [((16, 17, 8, 6), crop)], 3, 1, sensor)
    radius = sensor.blur_radius_px
    changed = (image != photograph).any(0)
    allowed = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    allowed[17 - radius : 23 + radius, 16 - radius : 24 + radius] = True
    assert not (changed & ~allowed).any()
    # And up to there they do change.
    rows, columns = changed.nonzero(as_tuple=True)
    assert (int(rows.min()), int(rows.max())) == (17 - radius, 22 + radius)
    assert (int(columns.min()), int(columns.max())) == (16 - radius, 23 + radius)


def test_the_blur_is_the_sensors_and_reaches_in_from_beyond_the_border():
    sensor = Sensor(2.4, noise=0.0)
    radius, sigma = sensor.blur_radius_px, sensor.blur_sigma_px
    # All that lies outside the left border is white; inside, the ground is black.
    crop = layers(radius, SIZE + 2 * radius, (1.0, 1.0, 1.0), alpha=1.0)
    image = composite_crops(
        plain(0.0), [((-radius, -radius, radius, SIZE + 2 * radius), crop)], 0, 1, sensor
    )
    weights = [math.exp(-0.5 * (step / sigma) ** 2) for step in range(-radius, radius + 1)]
    for column in range(radius + 1):
        expected = sum(weights[: radius - column]) / sum(weights)
        assert float(light(image)[0, 20, column]) == pytest.approx(expected, abs=1e-5)


def test_noise_lies_on_vehicles_alone_and_is_the_seeds():
    sensor = Sensor(blur_sigma_px=0.0, noise=0.02)
    crop = layers(30, 30, (0.2, 0.2, 0.2), ratio=(0.5, 0.5, 0.5))
    crop[:, :, :15] = layers(15, 30, (0.2, 0.2, 0.2), alpha=1.0)
    crops = [((5, 5, 30, 30), crop)]
    first, again = (composite_crops(plain(), crops, 7, 1, sensor) for _ in range(2))
    other, without = (
        composite_crops(plain(), crops, 8, 1, sensor),
        composite_crops(plain(), crops, 7, 1, SHARP),
    )
    assert torch.equal(first, again)
    difference = first - without
    assert float(difference[:, 5:35, 5:20].std()) == pytest.approx(0.02, rel=0.1)
    assert not difference[:, :, 20:].any()
    assert not torch.equal(first, other)


def test_a_body_is_shown_between_the_photographs_black_and_white():
    hazy = Light(white=(0.9, 0.7, 0.5), black=(0.1, 0.1, 0.2))
    crop = layers(20, 20, (0.5, 0.5, 0.5), alpha=1.0)
    image = light(composite_crops(plain(0.3), [((5, 5, 20, 20), crop)], 0, 1, SHARP, hazy))
    assert image[:, 15, 15].tolist() == pytest.approx([0.5, 0.4, 0.35], abs=1e-5)


def test_shaded_ground_sinks_to_the_photographs_black_and_not_below():
    hazy = Light(black=(0.1, 0.1, 0.1))
    crop = layers(20, 20, ratio=(0.0, 0.5, 1.0))
    image = light(composite_crops(plain(0.3), [((5, 5, 20, 20), crop)], 0, 1, SHARP, hazy))
    assert image[:, 15, 15].tolist() == pytest.approx([0.1, 0.2, 0.3], abs=1e-5)
