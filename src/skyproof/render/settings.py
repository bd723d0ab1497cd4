"""What the renderer can be told: light, material and sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, check_ranges
from skyproof.scenes.sensor import Blur, Noise, Sensor

__all__ = ["RenderSettings"]

_Samples = Annotated[int, Meta(ge=1, le=32)]


@dataclass(frozen=True)
class RenderSettings:
    """Light, material and sensor of the differentiable renderer.

    Attributes:
        supersampling: samples along a pixel's side (section S2.2); below 3 the silhouette gradients
            suffer.
        shadow_supersampling: the same for the cast shadow.
        blur_sigma_px: the sensor's Gaussian blur (section S2.1) of vehicles and shadows; None for
            that of the ground under them.
        noise: standard deviation of the sensor noise on rendered pixels, in sRGB units; a
            photograph has its own. None for that of the ground under them.
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
    blur_sigma_px: Blur | None = None
    noise: Noise | None = None
    sky_share: Fraction = 0.25
    shadow_light: tuple[Fraction, Fraction, Fraction] = (0.13, 0.156, 0.217)
    ground_reflectance: Fraction = 0.15
    reflectance: Fraction = 0.04
    glint_exponent: Annotated[float, Meta(ge=1, le=10_000)] = 40.0

    def __post_init__(self) -> None:
        check_ranges(self)

    def sensor_on(self, ground: Sensor) -> Sensor:
        """Returns what shows vehicles on ground that the given sensor took."""
        return Sensor(
            ground.blur_sigma_px if self.blur_sigma_px is None else self.blur_sigma_px,
            ground.noise if self.noise is None else self.noise,
        )
