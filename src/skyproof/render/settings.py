"""What the renderer can be told: light, material and sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, check_ranges
from skyproof.scenes.light import Light
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
        light: exposure, haze and sky that vehicles are drawn in; None for those of the ground
            under them.
        gloss: the share of what glass and clear coats mirror that vehicles do mirror; 0 is matt.
        ground_reflectance: mean albedo of the ground, which lights surfaces that face down.
    """

    supersampling: _Samples = 4
    shadow_supersampling: _Samples = 2
    blur_sigma_px: Blur | None = None
    noise: Noise | None = None
    light: Light | None = None
    gloss: Fraction = 1.0
    ground_reflectance: Fraction = 0.15

    def __post_init__(self) -> None:
        check_ranges(self)

    def sensor_on(self, ground: Sensor) -> Sensor:
        """Returns what shows vehicles on ground that the given sensor took."""
        return Sensor(
            ground.blur_sigma_px if self.blur_sigma_px is None else self.blur_sigma_px,
            ground.noise if self.noise is None else self.noise,
        )
