"""Sun and sky as light sources whose sum is what the photograph was exposed for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from skyproof.scenes.scene import Sun

__all__ = ["SUN_DIAMETER_RAD", "Daylight", "daylight"]

SUN_DIAMETER_RAD = math.radians(0.53)

_ROWS, _COLUMNS = 32, 64
# CIE standard general sky (ISO 15469:2004), luminance by zenith distance Z and distance from the
# sun: (1 + a exp(b / cos Z)) (1 + c (exp(d x) - exp(d pi / 2)) + e cos^2 x).
_CLEAR = (-1.0, -0.32, 10.0, -3.0, 0.45)  # type 12: standard clear sky
_OVERCAST = (4.0, -0.7, 0.0, -1.0, 0.0)  # type 1: standard overcast sky
# A clear sky's daylight of 10,000 K on the CIE daylight locus (CIE 15) in linear sRGB, luminance 1:
# what white, which is daylight of 6,504 K, is to the whole light.
_CLEAR_COLOUR = (0.824, 1.012, 1.403)


@dataclass(frozen=True)
class Daylight:
    """Light on a scene, in units in which a white matt surface on open ground sends 1.

    Attributes:
        sun_irradiance: linear red, green, blue across the sun's rays.
        sky: `[32, 64, 3]` linear radiance by elevation (90 degrees in the first row, -90 in the
            last) and azimuth, as Blender's environment texture wants it: the middle column looks
            along +x, columns go clockwise seen from above; nothing below the horizon.
    """

    sun_irradiance: tuple[float, float, float]
    sky: Float[np.ndarray, "32 64 3"]


def daylight(sun: Sun, clear_sky_share: float, overcast: float) -> Daylight:
    """Returns sun and sky, whose irradiances on level ground add up to pi in every channel.

    Args:
        sun: where it stands.
        clear_sky_share: the sky's part of the light under a clear sky.
        overcast: the part of the sun's direct light that comes from the whole sky instead, 0 to 1.
    """
    clear = (1 - overcast) * clear_sky_share * np.array(_CLEAR_COLOUR)
    direct = 1 - overcast - clear
    sky = clear * _dome(_CLEAR, sun)[..., None] + overcast * _dome(_OVERCAST, sun)[..., None]
    red, green, blue = (np.pi * np.maximum(direct, 0.0) / math.sin(sun.elevation_rad)).tolist()
    return Daylight((red, green, blue), sky.astype(np.float32))


def _dome(
    coefficients: tuple[float, float, float, float, float], sun: Sun
) -> Float[np.ndarray, "32 64"]:
    """Returns the sky's luminance, scaled so that a white matt surface under it alone sends 1."""
    a, b, c, d, e = coefficients
    elevation = np.pi / 2 - (np.arange(_ROWS) + 0.5) * np.pi / _ROWS
    azimuth = np.pi - (np.arange(_COLUMNS) + 0.5) * 2 * np.pi / _COLUMNS
    up = np.sin(elevation)[:, None].clip(1e-3)
    outward = np.cos(elevation)[:, None]
    x, y, z = sun.direction
    towards_sun = (
        outward * (np.cos(azimuth) * x + np.sin(azimuth) * y) + np.sin(elevation)[:, None] * z
    )
    distance = np.arccos(towards_sun.clip(-1, 1))
    around_sun = 1 + c * (np.exp(d * distance) - np.exp(d * np.pi / 2)) + e * np.cos(distance) ** 2
    dome = (1 + a * np.exp(b / up)) * around_sun * (elevation > 0)[:, None]
    solid_angle = outward * (np.pi / _ROWS) * (2 * np.pi / _COLUMNS)
    return dome / ((dome * np.sin(elevation)[:, None] * solid_angle).sum() / np.pi)
