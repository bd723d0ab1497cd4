"""The sensor that took a set of photographs (section S2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import check_ranges

__all__ = ["Blur", "Noise", "Sensor"]

Blur = Annotated[float, Meta(ge=0, le=10)]
Noise = Annotated[float, Meta(ge=0, le=0.5)]


@dataclass(frozen=True)
class Sensor:
    """Blur and noise of imagery at its ground resolution.

    The defaults are the paper's blur and a quiet sensor.

    Attributes:
        blur_sigma_px: standard deviation of the Gaussian blur, 0 to 10.
        noise: standard deviation of the noise, sRGB units, 0 to 0.5.
    """

    blur_sigma_px: Blur = 2.4
    noise: Noise = 0.006

    def __post_init__(self) -> None:
        check_ranges(self)
