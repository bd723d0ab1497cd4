"""The sky's brightness over its directions, as the ISO standard for daylight has it."""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

SkyType = tuple[float, float, float, float, float]
"""Coefficients a, b, c, d, e of the CIE standard general sky (ISO 15469:2004)."""

CLEAR: SkyType = (-1.0, -0.32, 10.0, -3.0, 0.45)
"""Type 12: standard clear sky of low turbidity."""
OVERCAST: SkyType = (4.0, -0.7, 0.0, -1.0, 0.0)
"""Type 1: standard overcast sky."""

_LOWEST = 1e-2
_ROWS, _COLUMNS = 32, 64


def relative_luminance(
    kind: SkyType, up: Float[Tensor, "*S"], towards_sun: Float[Tensor, "*S"]
) -> Float[Tensor, "*S"]:
    """Computes the luminance of the CIE standard general sky, up to a common factor.

    (1 + a exp(b / cos Z)) (1 + c (exp(d x) - exp(d pi / 2)) + e cos^2 x), with the zenith distance
    Z and the distance from the sun x. `up` and `towards_sun` are the cosines; below the horizon
    `up` is that of the horizon.
    """
    a, b, c, d, e = kind
    gradation = 1 + a * torch.exp(b / up.clamp(min=_LOWEST))
    if not c and not e:
        return gradation
    distance = torch.arccos(towards_sun.clamp(-0.9999, 0.9999))
    around = 1 + c * (torch.exp(d * distance) - math.exp(d * math.pi / 2))
    return gradation * (around + e * towards_sun.square())


@lru_cache(maxsize=256)
def mean_luminance(kind: SkyType, sun_elevation_deg: int) -> float:
    """Computes the luminance of an even sky that lights level ground as much; whole degrees for few
    calls.
    """
    rows = torch.arange(_ROWS, dtype=torch.float64)
    columns = torch.arange(_COLUMNS, dtype=torch.float64)
    elevation = ((rows + 0.5) / _ROWS * math.pi / 2)[:, None]
    azimuth = (columns + 0.5) / _COLUMNS * 2 * math.pi
    sun_rad = math.radians(sun_elevation_deg)
    up = elevation.sin().expand(-1, _COLUMNS)
    towards_sun = math.cos(sun_rad) * elevation.cos() * azimuth.cos() + math.sin(sun_rad) * up
    weight = elevation.cos() * up
    return float((relative_luminance(kind, up, towards_sun) * weight).sum() / weight.sum())
