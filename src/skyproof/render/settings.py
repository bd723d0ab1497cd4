"""Settings of the renderer: light, material and sensor."""

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Checked, Fraction
from skyproof.scenes.light import Light
from skyproof.scenes.sensor import Blur, Noise, Sensor

_Samples = Annotated[int, Meta(ge=1, le=32)]

# Edges of real bodies are rounder than those of meshes: on photographs at 12.5 cm the outlines and
# panes of vehicles are softer than the ground's own edges by as much as this blur adds
# (docs/imagery.md).
_ROUNDING_M = 0.05


@dataclass(frozen=True)
class RenderSettings(Checked):
    """Light, material and sensor of the differentiable renderer.

    Attributes:
        supersampling: samples along a pixel's side (section S2.2); below 3 the silhouette gradients
            suffer.
        shadow_supersampling: the same for cast shadows, on the ground and on the vehicle itself.
        blur_sigma_px: Gaussian blur of vehicles and shadows (section S2.1); the default is the
            ground's, plus that of rounded edges.
        noise: standard deviation of the sensor noise on rendered pixels, sRGB units; the default is
            the ground's.
        light: exposure, haze and sky on vehicles; the default is the ground's.
        self_shadows: whether vehicles shade themselves from the sun.
        gloss: share of the reflections of glass and clear coats; 0 is matt.
        ground_reflectance: mean albedo of the ground, which lights surfaces that face down.
    """

    supersampling: _Samples = 4
    shadow_supersampling: _Samples = 2
    blur_sigma_px: Blur | None = None
    noise: Noise | None = None
    light: Light | None = None
    self_shadows: bool = True
    gloss: Fraction = 1.0
    ground_reflectance: Fraction = 0.15

    def sensor_on(self, ground: Sensor, gsd_m: float) -> Sensor:
        """Returns the sensor for vehicles on ground that the given sensor took."""
        as_the_ground = math.hypot(ground.blur_sigma_px, _ROUNDING_M / gsd_m)
        return Sensor(
            round(as_the_ground, 3) if self.blur_sigma_px is None else self.blur_sigma_px,
            ground.noise if self.noise is None else self.noise,
        )
