"""What the renderer can be told: light, material and sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, check_ranges
from skyproof.scenes.sensor import Blur, Noise, Sensor

__all__ = ["RenderSettings"]

_Samples = Annotated[int, Meta(ge=1, le=32)]
_SHARPEST_PX = 0.01


@dataclass(frozen=True)
class RenderSettings:
    """Light, material and sensor of the differentiable renderer.

    Attributes:
        supersampling: samples along a pixel's side (section S2.2); below 3 the silhouette gradients
            suffer.
        shadow_supersampling: the same for the cast shadow.
        blur_sigma_px: the sensor's Gaussian blur (section S2.1), as wide as the paper found best.
        noise: standard deviation of the sensor noise on rendered pixels, in sRGB units; a
            photograph has its own.
        sky_share: the sky's part of the light on level ground. 0.25 is a clear day (diffuse
            fraction of global irradiance, 0.15-0.3 for a clear sky: Iqbal 1983).
        shadow_light: what is left of red, green and blue light in a vehicle's cast shadow: the
            share of a clear, blue sky, of which the vehicle itself hides a good third. As path
            tracing has it on average (docs/cycles.md).
        ground_reflectance: mean albedo of the ground, which lights surfaces that face down.
        reflectance: of the clear coat at normal incidence; 0.04 is a refractive index of 1.5.
        glint_exponent: sharpness of the sun's glint (normalised Blinn-Phong).
    """

    supersampling: _Samples = 4
    shadow_supersampling: _Samples = 2
    blur_sigma_px: Blur = Sensor.blur_sigma_px
    noise: Noise = Sensor.noise
    sky_share: Fraction = 0.25
    shadow_light: tuple[Fraction, Fraction, Fraction] = (0.13, 0.156, 0.217)
    ground_reflectance: Fraction = 0.15
    reflectance: Fraction = 0.04
    glint_exponent: Annotated[float, Meta(ge=1, le=10_000)] = 40.0

    def __post_init__(self) -> None:
        check_ranges(self)

    @classmethod
    def of(cls, sensor: Sensor) -> RenderSettings:
        """The settings for photographs that this sensor took."""
        return cls(blur_sigma_px=sensor.blur_sigma_px, noise=sensor.noise)

    @property
    def blur_radius_px(self) -> int:
        """Half of the paper's kernel size k = 6 * ceil(sigma) - 1, less the middle pixel."""
        # A narrower kernel is one pixel, and would divide by nearly nothing.
        sharp = self.blur_sigma_px < _SHARPEST_PX
        return 0 if sharp else 3 * math.ceil(self.blur_sigma_px) - 1
