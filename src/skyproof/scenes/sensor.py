"""The sensor that took a set of photographs (section S2.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from skyproof.errors import ConfigurationError

__all__ = ["Sensor"]


@dataclass(frozen=True)
class Sensor:
    """Blur and noise of imagery at its ground resolution.

    The defaults are the paper's blur and a quiet sensor.

    Attributes:
        blur_sigma_px: standard deviation of the Gaussian blur.
        noise: standard deviation of the noise, sRGB units in [0, 1].
    """

    blur_sigma_px: float = 2.4
    noise: float = 0.006

    def __post_init__(self) -> None:
        if (
            not 0 <= self.blur_sigma_px <= 10
            or not math.isfinite(self.noise)
            or not 0 <= self.noise <= 0.5
        ):
            raise ConfigurationError(
                f"A sensor expects a blur of 0 to 10 px and noise of 0 to 0.5, "
                f"got {self.blur_sigma_px} and {self.noise}."
            )
