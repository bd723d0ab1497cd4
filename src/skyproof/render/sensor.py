"""What the sensor does to rendered light: blur, and noise that is tied to image pixels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.scenes.sensor import Sensor

__all__ = ["blurred", "sensor_noise"]

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 64
# The blur of a large picture is worked out in bands of this many rows.
_BAND_PX = 64


def blurred(
    pictures: Float[Tensor, "B C S S"], sensors: Sequence[Sensor]
) -> Float[Tensor, "B C S S"]:
    """Returns square pictures under their sensors' Gaussian blur, zero beyond their ends.

    Args:
        pictures: linear light or coverage.
        sensors: one per picture.
    """
    radius_px = max(sensor.blur_radius_px for sensor in sensors)
    if radius_px == 0:
        return pictures
    kernels = _blur_matrices(pictures.shape[-1], sensors, radius_px, pictures)
    size = kernels.shape[-1]
    if size < 3 * _BAND_PX:
        return kernels @ pictures @ kernels
    # Far from its diagonal a kernel is zero: a band of rows needs only the rows near it.
    bands = []
    for start in range(0, size, _BAND_PX):
        stop = min(start + _BAND_PX, size)
        bands.append((start, stop, max(0, start - radius_px), min(size, stop + radius_px)))
    rows = [
        kernels[..., start:stop, low:high] @ pictures[..., low:high, :]
        for start, stop, low, high in bands
    ]
    pictures = torch.cat(rows, dim=-2)
    columns = [
        pictures[..., low:high] @ kernels[..., low:high, start:stop]
        for start, stop, low, high in bands
    ]
    return torch.cat(columns, dim=-1)


def _blur_matrices(
    size: int, sensors: Sequence[Sensor], radius_px: int, like: Tensor
) -> Float[Tensor, "B 1 S S"]:
    """Returns each sensor's blur of a row of pixels as a banded matrix, zero beyond the ends."""
    weights = torch.zeros(len(sensors), radius_px + 2, dtype=like.dtype)
    for row, sensor in zip(weights, sensors, strict=True):
        reach = sensor.blur_radius_px
        # A sensor without blur keeps the middle pixel alone.
        sigma_px = sensor.blur_sigma_px if reach else 1.0
        whole = torch.arange(-reach, reach + 1, dtype=torch.float64)
        total = float(torch.exp(-0.5 * (whole / sigma_px) ** 2).sum())
        half = torch.arange(reach + 1, dtype=like.dtype)
        row[: reach + 1] = torch.exp(-0.5 * (half / sigma_px) ** 2) / total
    steps = torch.arange(size, device=like.device)
    distance = (steps[:, None] - steps).abs().clamp(max=radius_px + 1)
    return weights.to(like.device)[:, None, distance]


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
