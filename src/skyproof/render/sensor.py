"""What the sensor does to rendered light: blur, and noise that is tied to image pixels."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.scenes.sensor import Sensor

# Sensor noise repeats after this many pixels; only vehicles, far smaller, show it.
_NOISE_TILE_PX = 64
# The blur of a large picture is worked out in bands of this many rows.
_BAND_PX = 64


def blurred(
    pictures: Float[Tensor, "B C S S"],
    sensors: Sequence[Sensor],
    corner: Int[Tensor, "B 2"],
    shape: tuple[int, int],
) -> Float[Tensor, "B C H W"]:
    """Returns parts of square pictures under their sensors' Gaussian blur, zero beyond their ends.

    A part is a top-left pixel (x, y), which may lie outside the picture, and the width and height
    of all parts.
    """
    radius_px = max(sensor.blur_radius_px for sensor in sensors)
    size = pictures.shape[-1]
    weights = _blur_weights(sensors, radius_px, pictures)
    columns = _blur_matrices(weights, size, corner[:, 0], shape[0]).mT
    rows = _blur_matrices(weights, size, corner[:, 1], shape[1])
    if size < 3 * _BAND_PX:
        return rows @ pictures @ columns
    # A kernel is zero far from its diagonal: a band of rows needs only the rows near it.
    pictures = torch.cat(
        [
            rows[..., start:stop, low:high] @ pictures[..., low:high, :]
            for start, stop, low, high in _bands(corner[:, 1], shape[1], size, radius_px)
        ],
        dim=-2,
    )
    return torch.cat(
        [
            pictures[..., low:high] @ columns[..., low:high, start:stop]
            for start, stop, low, high in _bands(corner[:, 0], shape[0], size, radius_px)
        ],
        dim=-1,
    )


def _bands(
    first: Int[Tensor, " B"], length: int, size: int, radius_px: int
) -> list[tuple[int, int, int, int]]:
    """Returns from where to where each band is, and which pixels of any picture reach into it."""
    least = int(first.min()) - radius_px
    most = int(first.max()) + radius_px
    bands = []
    for start in range(0, length, _BAND_PX):
        stop = min(start + _BAND_PX, length)
        low = min(max(0, start + least), size)
        bands.append((start, stop, low, max(low, min(size, stop + most))))
    return bands


def _blur_weights(sensors: Sequence[Sensor], radius_px: int, like: Tensor) -> Float[Tensor, "B _"]:
    """Returns the weight of pixels by their distance, from 0 to where it is zero for all."""
    reaches = torch.tensor([[sensor.blur_radius_px] for sensor in sensors])
    # A sensor without blur keeps the middle pixel alone.
    sigmas_px = [[sensor.blur_sigma_px or 1.0] for sensor in sensors]
    distances = torch.arange(radius_px + 2)
    weights = torch.exp(-0.5 * (distances / torch.tensor(sigmas_px, dtype=torch.float64)) ** 2)
    weights = weights.masked_fill(distances > reaches, 0.0)
    # All but the middle one stand on both sides.
    total = 2 * weights.sum(1, keepdim=True) - weights[:, :1]
    return (weights / total).to(like)


def _blur_matrices(
    weights: Float[Tensor, "B _"], size: int, first: Int[Tensor, " B"], length: int
) -> Float[Tensor, "B 1 L S"]:
    """Returns each picture's blur as a banded matrix, for `length` of its `size` pixels."""
    to = first[:, None, None] + torch.arange(length, device=first.device)[:, None]
    distance = (to - torch.arange(size, device=first.device)).abs()
    distance = distance.clamp(max=weights.shape[1] - 1).flatten(1)
    return weights.gather(1, distance).view(len(first), 1, length, size)


def sensor_noise(
    seeds: Sequence[int],
    y: Int[Tensor, "B S"],
    x: Int[Tensor, "B S"],
    like: Float[Tensor, "B 3 S S"],
) -> Float[Tensor, "B 3 S S"]:
    """Returns unit noise on rows and columns of images, tied to each scene's seed and to pixels."""
    shape = (3, _NOISE_TILE_PX, _NOISE_TILE_PX)
    drawn = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    tiles = torch.stack(drawn).to(like).permute(0, 2, 3, 1)
    image = torch.arange(len(seeds), device=like.device)[:, None, None]
    rows = (y % _NOISE_TILE_PX)[:, :, None]
    columns = (x % _NOISE_TILE_PX)[:, None, :]
    return tiles[image, rows, columns].permute(0, 3, 1, 2)
