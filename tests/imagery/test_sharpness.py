"""Blur and noise measured on drawn rectangles whose blur and noise are known."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from skyproof.errors import ImageryError
from skyproof.imagery.photographs import measure_sensor

SIZE, FINER = 320, 4


def photograph(sigma_px, noise=0.006, seed=0):
    """Rectangles of any brightness and heading, blurred in linear light, as sRGB bytes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : SIZE * FINER, 0 : SIZE * FINER] / FINER
    light = np.full(x.shape, 0.15)
    for _ in range(25):
        centre_x, centre_y = rng.uniform(0, SIZE, 2)
        turn, (length, width) = rng.uniform(0, np.pi), rng.uniform(15, 60, 2)
        along = (x - centre_x) * np.cos(turn) + (y - centre_y) * np.sin(turn)
        across = (y - centre_y) * np.cos(turn) - (x - centre_x) * np.sin(turn)
        light[(abs(along) < length / 2) & (abs(across) < width / 2)] = rng.uniform(0.05, 0.8)
    light = ndimage.gaussian_filter(light.reshape(SIZE, FINER, SIZE, FINER).mean((1, 3)), sigma_px)
    srgb = np.where(
        light <= 0.0031308, light * 12.92, 1.055 * light.clip(1e-9) ** (1 / 2.4) - 0.055
    )
    pixels = (srgb + rng.normal(0, noise, srgb.shape)).clip(0, 1) * 255
    return torch.from_numpy(pixels.round().astype(np.uint8)).expand(3, -1, -1)


@pytest.mark.parametrize("sigma_px", [0.6, 0.8, 1.0, 1.3])
def test_finds_the_blur(sigma_px):
    measured = measure_sensor(photograph(sigma_px, seed=seed) for seed in range(3)).blur_sigma_px
    assert measured == pytest.approx(sigma_px, rel=0.12)


def test_a_wider_blur_is_a_larger_number():
    measured = [measure_sensor([photograph(sigma)]).blur_sigma_px for sigma in (0.5, 1.0, 1.7, 2.4)]
    assert measured == sorted(measured)
    assert 1.7 < measured[-1] < 2.5


@pytest.mark.parametrize("noise", [0.004, 0.012])
def test_finds_the_noise(noise):
    assert measure_sensor([photograph(1.0, noise)]).noise == pytest.approx(noise, rel=0.25)


def test_soft_edges_beside_sharp_ones_do_not_count():
    soft = photograph(0.7).clone()
    blurred = ndimage.gaussian_filter(soft[0].numpy().astype(float), 2.0)
    soft[:, :, : SIZE // 2] = torch.from_numpy(blurred.round().astype(np.uint8))[:, : SIZE // 2]
    assert measure_sensor([soft, photograph(0.7, seed=1)]).blur_sigma_px == pytest.approx(
        0.7, rel=0.2
    )


@pytest.mark.parametrize("images", [[], [torch.full((3, 100, 100), 90, dtype=torch.uint8)]])
def test_ground_without_edges_is_one_sentence(images):
    with pytest.raises(
        ImageryError,
        match="expects at least 100 clear edges but found 0; give sharper or larger images",
    ):
        measure_sensor(images)
