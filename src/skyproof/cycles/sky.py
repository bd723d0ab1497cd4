"""Sun and sky as light sources that add up to the light of the photograph's exposure."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from skyproof.render.lighting import CLEAR, OVERCAST, SkyType, relative_luminance
from skyproof.scenes.scene import Sun

SUN_DIAMETER_RAD = math.radians(0.53)

_ROWS, _COLUMNS = 32, 64


@dataclass(frozen=True)
class Daylight:
    """Light on a scene; a white matt surface on open ground sends 1.

    Attributes:
        sun_irradiance: linear red, green, blue across the sun's rays.
        sky: `[32, 64, 3]` linear radiance by elevation (90 degrees in the first row) and azimuth
            (the middle column looks along +x, columns go clockwise from above), for Blender's
            environment texture; zero below the horizon.
    """

    sun_irradiance: tuple[float, float, float]
    sky: Float[np.ndarray, "32 64 3"]


def daylight(sun: Sun, sky_light: tuple[float, float, float], clouds: float) -> Daylight:
    """Returns sun and sky, whose irradiances on level ground add up to pi in every channel.

    `sky_light` is the sky's share of the light on open ground, `clouds` the share of clouds in it.
    """
    dome = (1 - clouds) * _dome(CLEAR, sun) + clouds * _dome(OVERCAST, sun)
    share = np.array(sky_light)
    direct = np.pi * np.maximum(1 - share, 0.0) / math.sin(sun.elevation_rad)
    red, green, blue = direct.tolist()
    return Daylight((red, green, blue), (share * dome[..., None]).astype(np.float32))


def _dome(kind: SkyType, sun: Sun) -> Float[np.ndarray, "32 64"]:
    """Returns the sky's luminance, scaled so that a white matt surface under it alone sends 1."""
    elevation = np.pi / 2 - (np.arange(_ROWS) + 0.5) * np.pi / _ROWS
    azimuth = np.pi - (np.arange(_COLUMNS) + 0.5) * 2 * np.pi / _COLUMNS
    up = np.broadcast_to(np.sin(elevation)[:, None], (_ROWS, _COLUMNS))
    outward = np.cos(elevation)[:, None]
    x, y, z = sun.direction
    towards_sun = outward * (np.cos(azimuth) * x + np.sin(azimuth) * y) + up * z
    luminance = relative_luminance(kind, torch.tensor(up), torch.tensor(towards_sun)).numpy()
    dome = luminance * (up > 0)
    solid_angle = outward * (np.pi / _ROWS) * (2 * np.pi / _COLUMNS)
    return dome / ((dome * up * solid_angle).sum() / np.pi)
