"""Headings estimated from a picture and an upright box: drawn vehicles of known heading."""

import math

import numpy as np
import pytest
import torch

from skyproof.imagery.clearing.labelled import estimate_stance

GSD_M = 0.125
SIDE_PX = 96


def drawn(heading_rad, length_m=4.5, width_m=1.8, brightness=200, seed=0):
    """A rounded vehicle with dark windows and a shadow on noisy ground; and the box around it."""
    rng = np.random.default_rng(seed)
    rows, columns = (np.mgrid[: 4 * SIDE_PX, : 4 * SIDE_PX] + 0.5) / 4
    x = (columns - SIDE_PX / 2 + rng.uniform(-0.5, 0.5)) * GSD_M
    y = -(rows - SIDE_PX / 2 + rng.uniform(-0.5, 0.5)) * GSD_M
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)

    def inside(x, y, length_m, width_m, corner_m=0.3):
        u = np.abs(cosine * x + sine * y) - length_m / 2 + corner_m
        v = np.abs(-sine * x + cosine * y) - width_m / 2 + corner_m
        outside = np.hypot(np.maximum(u, 0), np.maximum(v, 0)) + np.minimum(np.maximum(u, v), 0)
        return outside < corner_m

    body = inside(x, y, length_m, width_m)
    image = np.full(body.shape, 120.0)
    image[inside(x - 0.7, y + 0.5, length_m, width_m)] = 60
    image[body] = brightness
    image[inside(x - 0.5 * cosine, y - 0.5 * sine, 0.7, width_m - 0.3, 0.05)] = 40
    image[inside(x + 1.4 * cosine, y + 1.4 * sine, 0.5, width_m - 0.3, 0.05)] = 40
    fine = image.reshape(SIDE_PX, 4, SIDE_PX, 4).mean((1, 3))
    picture = np.clip(fine + rng.normal(0, 4, (3, SIDE_PX, SIDE_PX)), 0, 255).astype(np.uint8)
    held = np.argwhere(body)
    top, left = held.min(0) / 4
    bottom, right = (held.max(0) + 1) / 4
    return torch.from_numpy(picture), (left, top, right, bottom)


def off_deg(found, heading_rad):
    return abs((math.degrees(found - heading_rad) + 90) % 180 - 90)


@pytest.mark.parametrize("brightness", [35, 230])
def test_headings_all_around_are_found_with_their_sign(brightness):
    errors, lengths, widths = [], [], []
    for number in range(36):
        heading_rad = math.radians(5 * number + 1)
        length_m = 3.8 + 0.04 * number
        image, box = drawn(heading_rad, length_m, brightness=brightness, seed=number)
        heading, length, width = estimate_stance(image, box, GSD_M)
        assert 0 <= heading < math.pi
        errors.append(off_deg(heading, heading_rad))
        lengths.append(abs(length - length_m))
        widths.append(abs(width - 1.8))
    assert np.median(errors) < 2.5
    assert max(errors) < 12
    assert np.mean(lengths) < 0.2
    assert np.mean(widths) < 0.15


def test_a_loose_box_still_tells_a_heading_from_its_mirror_image():
    errors = []
    for number in range(18):
        heading_rad = math.radians(10 * number + 5)
        image, (left, top, right, bottom) = drawn(heading_rad, seed=number)
        loose = (left - 2.5, top - 1.0, right + 1.5, bottom + 2.0)
        errors.append(off_deg(estimate_stance(image, loose, GSD_M)[0], heading_rad))
    assert np.median(errors) < 6
    assert max(errors) < 25


def test_lines_on_the_vehicle_make_up_for_sides_that_are_off():
    errors = []
    rng = np.random.default_rng(0)
    for number in range(36):
        heading_rad = math.radians(5 * number + 1)
        image, box = drawn(heading_rad, seed=number)
        off = np.array(box) + rng.normal(0, 0.3 / GSD_M, 4)
        errors.append(off_deg(estimate_stance(image, off, GSD_M)[0], heading_rad))
    assert np.median(errors) < 2
    assert np.mean(np.array(errors) < 10) > 0.95


def test_a_square_around_a_point_leaves_it_to_the_outline():
    errors = []
    for number in range(18):
        heading_rad = math.radians(10 * number + 5)
        image, _ = drawn(heading_rad, seed=number)
        middle, half = SIDE_PX / 2, 2.0 / GSD_M
        square = (middle - half, middle - half, middle + half, middle + half)
        errors.append(off_deg(estimate_stance(image, square, GSD_M)[0], heading_rad))
    assert np.median(errors) < 6


@pytest.mark.parametrize(("wide_m", "high_m"), [(12.0, 2.6), (8.0, 8.0), (0.8, 0.8)])
def test_a_box_that_fits_no_small_vehicle_has_no_heading(wide_m, high_m):
    image, _ = drawn(0.3)
    half_x, half_y = wide_m / GSD_M / 2, high_m / GSD_M / 2 * 1.01
    box = (48 - half_x, 48 - half_y, 48 + half_x, 48 + half_y)
    assert estimate_stance(image, box, GSD_M) is None
