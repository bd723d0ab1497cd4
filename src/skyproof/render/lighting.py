"""The light of scenes: sky (ISO 15469), photographs under weather (sections S2.2, S7), surfaces."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.render.placed import Placed
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Scene

SkyType = tuple[float, float, float, float, float]
"""Coefficients a, b, c, d, e of the CIE standard general sky (ISO 15469:2004)."""

CLEAR: SkyType = (-1.0, -0.32, 10.0, -3.0, 0.45)
"""Type 12: standard clear sky of low turbidity."""
OVERCAST: SkyType = (4.0, -0.7, 0.0, -1.0, 0.0)
"""Type 1: standard overcast sky."""

_LOWEST = 1e-2
_ROWS, _COLUMNS = 32, 64
LEAST_ROOM = 1e-3
NEARLY_WHITE = 0.98
# A sky that gives more of the light than this has clouds in it.
_CLEAR_SHARE = 0.35


def relative_luminance(
    kind: SkyType, up: Float[Tensor, "*S"], towards_sun: Float[Tensor, "*S"]
) -> Float[Tensor, "*S"]:
    """Computes the luminance of the CIE standard general sky, up to a common factor.

    (1 + a exp(b / cos Z)) (1 + c (exp(d x) - exp(d pi / 2)) + e cos^2 x), with the zenith distance
    Z and the distance from the sun x. `up` and `towards_sun` are the cosines; below the horizon
    `up` is that of the horizon.
    """
    a, b, c, d, e = kind
    gradation = 1 + a * torch.exp(b / up.clamp(min=_LOWEST))
    distance = torch.arccos(towards_sun.clamp(-0.9999, 0.9999))
    around = 1 + c * (torch.exp(d * distance) - math.exp(d * math.pi / 2))
    return gradation * (around + e * towards_sun.square())


@lru_cache(maxsize=256)
def mean_luminance(kind: SkyType, sun_elevation_deg: int) -> float:
    """Computes the luminance of an even sky that lights level ground as much as this sky."""
    rows = torch.arange(_ROWS, dtype=torch.float64)
    columns = torch.arange(_COLUMNS, dtype=torch.float64)
    elevation = ((rows + 0.5) / _ROWS * math.pi / 2)[:, None]
    azimuth = (columns + 0.5) / _COLUMNS * 2 * math.pi
    sun_rad = math.radians(sun_elevation_deg)
    up = elevation.sin().expand(-1, _COLUMNS)
    towards_sun = math.cos(sun_rad) * elevation.cos() * azimuth.cos() + math.sin(sun_rad) * up
    weight = elevation.cos() * up
    return float((relative_luminance(kind, up, towards_sun) * weight).sum() / weight.sum())


@dataclass(frozen=True)
class SceneLights:
    """How B pictures show light, linear and per channel.

    `white` and `black` are the shown values of a white matt surface in the open sun, and of no
    light. From `shoulder` on the picture bends towards its brightest value. `sky` is the sky's
    share of the light on open ground, `overcast` the share of clouds in the sky's light.
    """

    white: Float[Tensor, "B 3"]
    black: Float[Tensor, "B 3"]
    shoulder: Float[Tensor, "B 1"]
    sky: Float[Tensor, "B 3"]
    overcast: Float[Tensor, "B 1"]

    def of(self, index: int) -> "SceneLights":
        """Returns one picture's light, as a batch of its own."""
        single = slice(index, index + 1)
        return SceneLights(*(getattr(self, each.name)[single] for each in fields(self)))

    def shown(self, light: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Returns the shown values of light, linear and not clipped.

        Above its shoulder s the camera shows s + (1 - s) tanh((x - s) / (1 - s)) for x.
        """
        black, white, shoulder = self._levels()
        value = black + light * (white - black)
        room = (1 - shoulder).clamp(min=LEAST_ROOM)
        above = shoulder + room * torch.tanh((value - shoulder).clamp(min=0.0) / room)
        return torch.where(value > shoulder, torch.where(shoulder < 1, above, value), value)

    def received(self, shown: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Returns the light behind shown values: the inverse of `shown`, never below 0.

        A white pixel counts as only a little brighter than white.
        """
        black, white, shoulder = self._levels()
        room = (1 - shoulder).clamp(min=LEAST_ROOM)
        part = ((shown - shoulder).clamp(min=0.0) / room).clamp(max=NEARLY_WHITE)
        straight = shoulder + room * torch.arctanh(part)
        value = torch.where(shown > shoulder, torch.where(shoulder < 1, straight, shown), shown)
        return ((value - black) / (white - black)).clamp(min=0.0)

    def _levels(self) -> tuple[Tensor, Tensor, Tensor]:
        black = self.black[:, :, None, None]
        # Haze as bright as white would leave no contrast, so a little is kept.
        white = torch.maximum(self.white[:, :, None, None], black + LEAST_ROOM)
        return black, white, self.shoulder[:, :, None, None]


def sky_light(light: Light, overcast: float) -> tuple[tuple[float, float, float], float]:
    """Returns the sky's share of the light, and the share of clouds in it, in weather that spreads
    a share `overcast` of the direct sun over the sky.
    """
    red, green, blue = (share + (1 - share) * overcast for share in light.sky)
    mean = (red + green + blue) / 3
    clouds = min(max((mean - _CLEAR_SHARE) / (1 - _CLEAR_SHARE), 0.0), 1.0)
    return (red, green, blue), clouds


def scene_lights(lights: Sequence[Light], scenes: Sequence[Scene], like: Tensor) -> SceneLights:
    """Returns the light of scenes from that of their photographs, one for each scene."""
    skies = [
        sky_light(light, scene.weather.overcast)
        for light, scene in zip(lights, scenes, strict=True)
    ]
    return SceneLights(
        white=like.new_tensor([light.white for light in lights]),
        black=like.new_tensor([light.black for light in lights]),
        shoulder=like.new_tensor([[light.shoulder] for light in lights]),
        sky=like.new_tensor([sky for sky, _ in skies]),
        overcast=like.new_tensor([[clouds] for _, clouds in skies]),
    )


def lighting(
    placed: Placed, lights: SceneLights, settings: RenderSettings
) -> Float[Tensor, "N 20"]:
    """Returns the light on each vehicle as one row, as `kernels.light.SurfaceLight` has it.

    Terms that are the same all over a vehicle are computed once.
    """
    elevations = torch.rad2deg(torch.arcsin(placed.sun[:, 2].clamp(0.0, 1.0))).round().tolist()
    means = [[mean_luminance(CLEAR, int(degrees))] for degrees in elevations]
    sky, sun, viewer = lights.sky[placed.scene], placed.sun, placed.viewer
    # The sun's light on level ground, and the light that the ground sends back.
    direct = (1 - sky) * placed.sunlit[:, None]
    ground = settings.ground_reflectance * (direct + sky)
    scalars = (
        (sun * viewer).sum(1, keepdim=True),
        (sun + viewer).norm(dim=1, keepdim=True).reciprocal(),
        lights.overcast[placed.scene],
        sun.new_tensor(means).reciprocal(),
        sun.new_full((len(sun), 1), settings.gloss),
    )
    return torch.cat((sun, viewer, sky, direct / sun[:, 2:], ground, *scalars), dim=1)
