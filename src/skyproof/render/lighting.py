"""The light of scenes: that of their photographs, under their weather (sections S2.2 and S7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.render.placed import Placed
from skyproof.render.shade import Lighting
from skyproof.render.sky import CLEAR, mean_luminance
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Scene

_LEAST_ROOM = 1e-3
_NEARLY_WHITE = 0.98
# A sky that gives more of the light than this has clouds in it.
_CLEAR_SHARE = 0.35


@dataclass(frozen=True)
class SceneLights:
    """How B pictures show light, linear and per channel.

    Attributes:
        white, black: shown values of a white matt surface in the open sun, and of no light.
        shoulder: value from which the picture bends towards its brightest value.
        sky: share of the sky in the light on open ground.
        overcast: share of clouds in the sky's light.
    """

    white: Float[Tensor, "B 3"]
    black: Float[Tensor, "B 3"]
    shoulder: Float[Tensor, "B 1"]
    sky: Float[Tensor, "B 3"]
    overcast: Float[Tensor, "B 1"]

    def of(self, index: int) -> SceneLights:
        """Returns one picture's light, as a batch of its own."""
        single = slice(index, index + 1)
        return SceneLights(*(getattr(self, each.name)[single] for each in fields(self)))

    def shown(self, light: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Returns the shown values of light in units of a white matt surface, linear and not
        clipped.

        Above its shoulder s the camera shows s + (1 - s) tanh((x - s) / (1 - s)) for x.
        """
        if self._plain:
            return light
        black, white, shoulder = self._levels()
        value = black + light * (white - black)
        room = (1 - shoulder).clamp(min=_LEAST_ROOM)
        above = shoulder + room * torch.tanh((value - shoulder).clamp(min=0.0) / room)
        return torch.where(value > shoulder, torch.where(shoulder < 1, above, value), value)

    def received(self, shown: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        """Returns the light behind shown values: the inverse of `shown`, never below 0.

        A white pixel counts as little brighter than white.
        """
        if self._plain:
            return shown
        black, white, shoulder = self._levels()
        room = (1 - shoulder).clamp(min=_LEAST_ROOM)
        part = ((shown - shoulder).clamp(min=0.0) / room).clamp(max=_NEARLY_WHITE)
        straight = shoulder + room * torch.arctanh(part)
        value = torch.where(shown > shoulder, torch.where(shoulder < 1, straight, shown), shown)
        return ((value - black) / (white - black)).clamp(min=0.0)

    @property
    def _plain(self) -> bool:
        """Whether the pictures show light as it is."""
        plain = (self.white == 1).all() & (self.black == 0).all() & (self.shoulder >= 1).all()
        return bool(plain)

    def _levels(self) -> tuple[Tensor, Tensor, Tensor]:
        black = self.black[:, :, None, None]
        # Where a haze as bright as white leaves nothing to show, a little is left.
        white = torch.maximum(self.white[:, :, None, None], black + _LEAST_ROOM)
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
    """Returns the light of scenes on photographs that show light so, one for each scene."""
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


def lighting(placed: Placed, lights: SceneLights) -> Lighting:
    """Returns the light on each vehicle."""
    scene: Int[Tensor, " N"] = placed.scene
    elevations = torch.rad2deg(torch.arcsin(placed.sun[:, 2].clamp(0.0, 1.0))).round().tolist()
    means = [[mean_luminance(CLEAR, int(degrees))] for degrees in elevations]
    return Lighting(
        sun=placed.sun,
        viewer=placed.viewer,
        sky=lights.sky[scene],
        overcast=lights.overcast[scene],
        sunlit=placed.sunlit[:, None],
        clear_mean=placed.sun.new_tensor(means),
    )
