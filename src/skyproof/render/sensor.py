"""What the sensor does to rendered light: blur, and noise that is tied to image pixels (section S2.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["blur_matrix", "sensor_noise"]

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 64


def blur_matrix(size: int, sigma_px: float, radius_px: int, like: Tensor) -> Float[Tensor, "S S"]:
    """The Gaussian blur of a row of pixels as a banded matrix, zero beyond the ends (section S2.1)."""
    steps = torch.arange(size, device=like.device)
    distance = (steps[:, None] - steps).abs()
    if radius_px == 0:
        return torch.eye(size, dtype=like.dtype, device=like.device)
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
    """Unit noise from every scene's own seed, tied to image pixels: the same whatever else is in the batch."""
    shape = (3, _NOISE_TILE_PX, _NOISE_TILE_PX)
    drawn = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    tile = torch.stack(drawn).to(like)
    image = torch.arange(len(seeds), device=like.device)
    rows, columns = y % _NOISE_TILE_PX, x % _NOISE_TILE_PX
    return tile.permute(0, 2, 3, 1)[
        image[:, None, None], rows[:, :, None], columns[:, None, :]
    ].permute(0, 3, 1, 2)
