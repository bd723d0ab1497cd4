"""Weather and light of one scene as plain numbers, and the conditions they are drawn from."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Checked, Fraction, Name

LOW_SUN_ELEVATION_RAD = (math.radians(8), math.radians(20))
"""The range of the sun's uniform elevation under "low_sun"."""


@dataclass(frozen=True)
class Weather(Checked):
    """Effects between the ground and the picture; the default is a clear day and a good camera.

    Attributes:
        condition: one of `CONDITIONS`, for tables; the numbers below decide the picture.
        haze: share of airlight in every pixel.
        wetness: share of the ground that is wet, and so darker.
        overcast: share of the direct sun that comes from the whole sky instead.
        exposure_stops: brightness factor 2^stops before clipping.
        noise: standard deviation on the whole picture, sRGB units.
    """

    condition: Name = "clear"
    haze: Fraction = 0.0
    wetness: Fraction = 0.0
    overcast: Fraction = 0.0
    exposure_stops: Annotated[float, Meta(ge=-16, le=16)] = 0.0
    noise: Fraction = 0.0
    jpeg_quality: Annotated[int, Meta(ge=1, le=95)] | None = None


CLEAR = Weather()


def _exposure(strength: float) -> Weather:
    """Half of the scenes are too dark, half too bright; none is nearly right."""
    side = 1 if strength >= 0.5 else -1
    return Weather("exposure", exposure_stops=side * _between(0.4, 1.0, abs(2 * strength - 1)))


# Every range, mild to strong, is listed with its reason in docs/vehicles.md.
CONDITIONS: dict[str, Callable[[float], Weather]] = {
    "clear": lambda strength: CLEAR,
    "haze": lambda strength: Weather("haze", haze=_between(0.15, 0.45, strength)),
    "rain": lambda strength: Weather("rain", wetness=_between(0.7, 1.0, strength)),
    # The lower the sun, the less of its direct light comes through the air.
    "low_sun": lambda strength: Weather("low_sun", overcast=_between(0.3, 0.05, strength)),
    "overcast": lambda strength: Weather("overcast", overcast=_between(0.6, 1.0, strength)),
    "exposure": _exposure,
    "noise": lambda strength: Weather("noise", noise=_between(0.015, 0.05, strength)),
    "jpeg": lambda strength: Weather("jpeg", jpeg_quality=round(_between(60.0, 20.0, strength))),
}
"""For each condition, the weather at a strength from 0 to 1 (section S7)."""

MIXED_CONDITIONS = ("clear", "haze", "overcast", "exposure", "noise", "jpeg", "low_sun")
"""Conditions of training: all but rain, which was never tested on photographs."""


def _between(first: float, last: float, strength: float) -> float:
    return first + (last - first) * strength
