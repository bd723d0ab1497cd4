"""What the sensor does to rendered light: blur, and noise that is tied to image pixels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["blurred", "sensor_noise"]

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 64
# The blur of a large picture is worked out in bands of this many rows.
_BAND_PX = 64


def blurred(
    picture: Float[Tensor, "*B S S"], sigma_px: float, radius_px: int
) -> Float[Tensor, "*B S S"]:
    """Returns square pictures under the sensor's Gaussian blur, zero beyond their ends.

    Args:
        picture: linear light or coverage.
        sigma_px: standard deviation.
        radius_px: the kernel ends after this many pixels; 0 leaves the picture as it is.
    """
    if radius_px == 0:
        return picture
    kernel = _blur_matrix(picture.shape[-1], sigma_px, radius_px, picture)
    size = len(kernel)
    if size < 3 * _BAND_PX:
        return kernel @ picture @ kernel
    # Far from its diagonal the kernel is zero: a band of rows needs only the rows near it.
    bands = []
    for start in range(0, size, _BAND_PX):
        stop = min(start + _BAND_PX, size)
        bands.append((start, stop, max(0, start - radius_px), min(size, stop + radius_px)))
    rows = [
        kernel[start:stop, low:high] @ picture[..., low:high, :] for start, stop, low, high in bands
    ]
    picture = torch.cat(rows, dim=-2)
    columns = [
        picture[..., low:high] @ kernel[low:high, start:stop] for start, stop, low, high in bands
    ]
    return torch.cat(columns, dim=-1)


def _blur_matrix(size: int, sigma_px: float, radius_px: int, like: Tensor) -> Float[Tensor, "S S"]:
    """Returns the blur of a row of pixels as a banded matrix, zero beyond the ends."""
    steps = torch.arange(size, device=like.device)
    distance = (steps[:, None] - steps).abs()
    weights = torch.exp(
        -0.5 * (torch.arange(-radius_px, radius_px + 1, dtype=torch.float64) / sigma_px) ** 2
    ).sum()
    kernel = torch.exp(-0.5 * (distance.to(like.dtype) / sigma_px) ** 2) / float(weights)
    return kernel * (distance <= radius_px)


def sensor_noise(
    seeds: Sequence[int],
    y: Int[Tensor, "B S"],
    x: Int[Tensor, "B S"],
    like: Float[Tensor, "B 3 S S"],
) -> Float[Tensor, "B 3 S S"]:
    """Returns unit noise on windows of images, from every scene's own seed.

    It is tied to image pixels, and so the same whatever else is in the batch.

    Args:
        seeds: one per image.
        y: rows of the image that the window's rows show.
        x: columns likewise.
        like: decides device and type.
    """
    shape = (3, _NOISE_TILE_PX, _NOISE_TILE_PX)
    drawn = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    tiles = torch.stack(drawn).to(like).permute(0, 2, 3, 1)
    image = torch.arange(len(seeds), device=like.device)[:, None, None]
    rows = (y % _NOISE_TILE_PX)[:, :, None]
    columns = (x % _NOISE_TILE_PX)[:, None, :]
    return tiles[image, rows, columns].permute(0, 3, 1, 2)
