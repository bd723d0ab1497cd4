"""The sun that photographs of one set share, for those that do not tell it themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyproof.scenes.light import SunEstimate

FEWEST_TO_SHARE = 3
"""Photographs that must agree before the light of others is taken from them."""
WITHIN_RAD = math.radians(20)
KNOWN_FROM = "other photographs of the set"

Array = NDArray[np.float64]


def shared_sun(suns: Sequence[SunEstimate]) -> SunEstimate | None:
    """Returns the median of suns that agree, as those of a flight or of neighbouring sheets do.

    Their own errors and how far they differ make its standard deviations.

    Args:
        suns: estimates in the same axes.

    Returns:
        None with fewer than 3, or where one's azimuth is off the median by more than 20 degrees.
    """
    if len(suns) < FEWEST_TO_SHARE:
        return None
    azimuths_rad = np.array([sun.azimuth_rad for sun in suns])
    elevations_rad = np.array([sun.elevation_rad for sun in suns])
    # The median on a circle: that one from which the others turn least.
    turns_rad = turned(azimuths_rad[None] - azimuths_rad[:, None])
    middle = int(np.abs(turns_rad).sum(1).argmin())
    if np.abs(turns_rad[middle]).max() > WITHIN_RAD:
        return None
    elevation_rad = float(np.median(elevations_rad))
    return SunEstimate(
        azimuth_rad=round(float(azimuths_rad[middle]) % (2 * math.pi), 4),
        elevation_rad=round(elevation_rad, 4),
        azimuth_sd_rad=_deviation([sun.azimuth_sd_rad for sun in suns], turns_rad[middle]),
        elevation_sd_rad=_deviation(
            [sun.elevation_sd_rad for sun in suns], elevations_rad - elevation_rad
        ),
        known_from=KNOWN_FROM,
    )


def turned(angles_rad: Array) -> Array:
    """Returns angles from -pi to pi."""
    within: Array = (angles_rad + math.pi) % (2 * math.pi) - math.pi
    return within


def _deviation(own_rad: Sequence[float], differences_rad: Array) -> float:
    spread_rad = float(np.sqrt(np.mean(np.square(differences_rad))))
    return round(math.hypot(float(np.median(own_rad)), spread_rad), 4)
