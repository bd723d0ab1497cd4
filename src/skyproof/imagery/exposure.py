"""Measures how photographs show light: white, black and the colour of grey, on their own ground.

Vehicles are then drawn as bright as the photograph would have shown them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.scenes.light import Light, rounded_levels

Array = NDArray[np.float64]
Item = TypeVar("Item")

_TILES_MEASURED = 16
STRIDE_PX = 3
FEWEST_PIXELS = 20_000
BRIGHT_SHARE = 0.999
DARK_SHARE = 0.002
GREY_SATURATION = 0.12
FEWEST_GREY = 0.02

# White is so many times as bright as the brightest thousandth of the ground (road markings, light
# roofs), and as its median. Fitted on drawn ground, whose white is known; the first says it within
# a quarter on a single tile of 37 m, the second within two fifths, and they are weighted so.
_WHITE_OF_BRIGHTEST = 1.6
_WHITE_OF_MEDIAN = 6.6
_WEIGHT_OF_BRIGHTEST = 0.8
_LEAST_WHITE, _LARGEST_WHITE = 0.3, 4.0
# Around a vehicle's middle nothing is taken for ground.
_VEHICLE_M = 3.5
# A surface in deep shadow still sends this share of what white sends.
_DEEPEST = 0.01


def some_of(tiles: Sequence[Item]) -> Sequence[Item]:
    """Takes every n-th tile, at most 31, so that measuring does not grow with the imagery."""
    return tiles[:: max(1, len(tiles) // _TILES_MEASURED)]


def ground_pixels(
    image: UInt8[Tensor, "3 H W"], vehicles_px: Float[Tensor, "n 2"], *, gsd_m: float
) -> UInt8[Tensor, "P 3"]:
    """Takes every third pixel along and across, but for those of vehicles.

    White paint and the sun's glints on it are far brighter than any ground: on aerial photographs
    of Munich they made white 1.5 times as bright as it was.

    Args:
        vehicles_px: the middles (x, y) of the vehicles in it.
    """
    sampled = image[:, ::STRIDE_PX, ::STRIDE_PX]
    rows, columns = sampled.shape[1:]
    x = torch.arange(columns) * STRIDE_PX + 0.5
    y = torch.arange(rows) * STRIDE_PX + 0.5
    free = torch.ones(rows, columns, dtype=torch.bool)
    for middle_x, middle_y in vehicles_px.tolist():
        distance_px = torch.hypot(x[None] - middle_x, y[:, None] - middle_y)
        free &= distance_px * gsd_m > _VEHICLE_M
    return sampled[:, free].T


def measure_exposure(grounds: Iterable[UInt8[Tensor, "P 3"]]) -> Light:
    """Measures white, black and white balance; the sky's part of the light stays the usual one.

    White is told by the brightest thousandth of the ground and by its median. Its colour is that of
    grey ground, the median of all pixels whose channels differ by at most 12 %; where hardly any
    ground is grey, it is neutral. Black is the darkest 0.2 % of each channel.

    Ground of one kind, such as a field alone or snow, misleads it: it takes a bright sand for a
    bright exposure. A tint of more than a tenth is found in part: under it grey is no longer grey.
    On drawn ground, the error of white is within a third on most single tiles, and within a tenth
    over forty (tests).

    Args:
        grounds: `ground_pixels` of tiles of one source.

    Raises:
        ImageryError: there is hardly anything to measure, or the imagery has one colour alone.
    """
    samples = [each.numpy() for each in grounds]
    pixels = np.concatenate(samples) if samples else np.zeros((0, 3))
    if len(pixels) < FEWEST_PIXELS // STRIDE_PX**2 or pixels.max() - pixels.min() < STRIDE_PX:
        raise ImageryError(
            "Measuring the light of imagery expects ground with something bright and something "
            f"dark on it but found {len(pixels)} pixels of nearly one colour; give more imagery."
        )
    light = _linear(np.asarray(pixels, np.uint8))
    luminance = light.mean(1)
    # White, by what is brightest and by what is usual.
    brightest, median = np.quantile(luminance, (BRIGHT_SHARE, 0.5))
    logarithm = _WEIGHT_OF_BRIGHTEST * np.log(_WHITE_OF_BRIGHTEST * brightest)
    logarithm += (1 - _WEIGHT_OF_BRIGHTEST) * np.log(_WHITE_OF_MEDIAN * max(median, 1e-3))
    white = float(np.clip(np.exp(logarithm), _LEAST_WHITE, _LARGEST_WHITE))
    # Its colour, by what is grey.
    spread = pixels.max(1).astype(float) - pixels.min(1)
    grey = light[spread <= GREY_SATURATION * np.maximum(pixels.max(1), 1)]
    balance = np.ones(3)
    if len(grey) >= FEWEST_GREY * len(pixels):
        middle = np.median(grey, axis=0)
        balance = middle / middle.mean()
    black = np.clip(np.quantile(light, DARK_SHARE, axis=0) - _DEEPEST * white, 0.0, 0.3)
    return Light(white=rounded_levels(white * balance), black=rounded_levels(black))


def _linear(pixels: NDArray[np.uint8]) -> Array:
    table = srgb_to_linear(torch.arange(256, dtype=torch.float64) / 255).numpy()
    return np.take(table, pixels)
