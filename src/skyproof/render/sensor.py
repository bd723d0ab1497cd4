"""What the sensor does to rendered light: blur, and noise that is tied to image pixels."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.scenes.sensor import Sensor

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 64


def blur_weights(sensors: Sequence[Sensor], radius_px: int, like: Tensor) -> Float[Tensor, "B _"]:
    """Returns the weight of pixels by their distance, from 0 to the radius."""
    reaches = torch.tensor([[sensor.blur_radius_px] for sensor in sensors])
    # A sensor without blur keeps the middle pixel alone.
    sigmas_px = [[sensor.blur_sigma_px or 1.0] for sensor in sensors]
    distances = torch.arange(radius_px + 1)
    weights = torch.exp(-0.5 * (distances / torch.tensor(sigmas_px, dtype=torch.float64)) ** 2)
    weights = weights.masked_fill(distances > reaches, 0.0)
    # All weights but the middle one count on both sides.
    total = 2 * weights.sum(1, keepdim=True) - weights[:, :1]
    return (weights / total).to(like)


def noise_tiles(seeds: Sequence[int]) -> Float[Tensor, "B 3 64 64"]:
    """Draws unit noise from each scene's seed; it is tied to pixels and repeats over the image."""
    shape = (3, _NOISE_TILE_PX, _NOISE_TILE_PX)
    drawn = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    return torch.stack(drawn)
