"""Light on visible samples: sun, sky, light from the ground, and what gloss mirrors."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.render.settings import RenderSettings
from skyproof.render.sky import CLEAR, OVERCAST, mean_luminance, relative_luminance

# Of the change from mirrored sky to mirrored ground, around the horizon.
_HORIZON_SHARPNESS = 12.0
# What of the vehicle hides the sun hides the brighter half of a clear sky, too, from what faces it:
# about as much as path tracing has it between bumps (docs/cycles.md), and as a vehicle takes from
# the ground close to it.
_SHADED_SKY_LOSS = 0.7
# In units of white; path tracing cuts single paths there, too.
_BRIGHTEST_GLINT = 5.0
# The logarithm of a glint's lobe where nothing of it is left.
_DARKEST_LOG = -80.0


@dataclass(frozen=True)
class Lighting:
    """The light on each of N vehicles, in units of a white matt surface on open ground.

    Attributes:
        sun, viewer: unit vectors towards sun and camera.
        sky: share of the sky in the light on open ground, red, green, blue.
        overcast: share of clouds in the sky's light.
        sunlit: share of the direct sun that the photograph's shadows leave.
        clear_mean: mean luminance of the clear sky.
    """

    sun: Float[Tensor, "N 3"]
    viewer: Float[Tensor, "N 3"]
    sky: Float[Tensor, "N 3"]
    overcast: Float[Tensor, "N 1"]
    sunlit: Float[Tensor, "N 1"]
    clear_mean: Float[Tensor, "N 1"]


def light(
    normal: Float[Tensor, "3 K"],
    lighting: Lighting,
    vehicle: Int[Tensor, " K"],
    sunlit: Float[Tensor, " _"],
    gloss: Float[Tensor, "2 _"],
    settings: RenderSettings,
) -> tuple[Float[Tensor, "3 K"], Float[Tensor, "3 K"]]:
    """Returns the diffuse light on a surface, and the radiance that its gloss mirrors, per channel.

    A white matt surface on open ground sends 1 in every channel at any elevation of the sun,
    because the exposure was set for its light. Radiance is albedo * diffuse + mirrored. The
    mirrored light does not reach the paint (Fresnel towards the viewer, as path tracers layer a
    coat).

    Args:
        normal: unit normals, world axes.
        vehicle: row of `lighting` for each sample.
        sunlit: share of the sun's light that its own vehicle lets through, per sample or one for
            all.
        gloss: columns of `gloss_table`, per sample or one for all.
    """
    # The sun's light across its rays, and the light that ground around sends back.
    direct = (1 - lighting.sky) * lighting.sunlit
    strength = direct * lighting.sun[:, 2:].reciprocal()
    ground = settings.ground_reflectance * (direct + lighting.sky)
    # What is the same all over a vehicle is worked out once for it, and looked up by its samples.
    sun_and_viewer = (lighting.sun * lighting.viewer).sum(1, keepdim=True)
    halving = (lighting.sun + lighting.viewer).norm(dim=1, keepdim=True).reciprocal()
    dimming = lighting.clear_mean.reciprocal()
    vectors = (lighting.sun, lighting.viewer, lighting.sky, strength, ground)
    scalars = (sun_and_viewer, halving, lighting.overcast, dimming)
    rows = torch.cat((*vectors, *scalars), dim=1).t().index_select(1, vehicle)
    sun, viewer, sky, strength, ground = rows[:15].split(3)
    sun_and_viewer, halving, overcast, dimming = rows[15:]
    # The more a surface faces down, the more of the ground before it is the vehicle's own shadow.
    # Squared, so that gradients do not jump at level normals.
    ground = ground * (1 - normal[2].clamp(max=0.0).square())
    towards_sun = (normal * sun).sum(0)
    facing_sun = towards_sun.clamp(min=0.0)
    sunny = facing_sun * sunlit
    sky_left = 1 - _SHADED_SKY_LOSS * (facing_sun - sunny) * (1 - overcast)
    open_sky = 0.5 + 0.5 * normal[2]
    diffuse = torch.addcmul(torch.lerp(ground, sky * sky_left, open_sky), strength, sunny)
    # Mirrored surroundings: from above, a steep side mirrors the ground, not the sky.
    reflectance, exponent = gloss
    # Where faces turn away, normals between their corners may before them: seen edge-on at most, or
    # sills would mirror the sky.
    cosine = (normal * viewer).sum(0).clamp(min=0.0)
    # Schlick's, for reflectances up to that of the table; nothing where nothing is mirrored.
    fresnel = reflectance + (settings.gloss - reflectance) * _fifth_power(
        (1 - cosine).clamp(min=0.0)
    )
    # Of the mirrored ray, 2 cosine normal - viewer, the height and the cosine to the sun.
    up = 2 * cosine * normal[2] - viewer[2]
    clear = relative_luminance(CLEAR, up, 2 * cosine * towards_sun - sun_and_viewer)
    luminance = torch.lerp(clear * dimming, _overcast(up), overcast)
    surroundings = torch.lerp(ground, sky * luminance, torch.sigmoid(up * _HORIZON_SHARPNESS))
    # The sun's glint, which a sensor shows as white long before it ends. Its lobe is around the
    # direction half-way from the sun to the viewer. A power takes far longer than exp and log, and
    # exp far longer where it vanishes.
    aligned = ((towards_sun + cosine) * halving).clamp(min=1e-6)
    lobe = torch.exp((exponent * aligned.log()).clamp(min=_DARKEST_LOG))
    peak = reflectance * (exponent + 8) / 8
    glint = (peak * lobe * sunny * strength).clamp(max=_BRIGHTEST_GLINT)
    return diffuse * (1 - fresnel), torch.addcmul(glint, fresnel, surroundings)


def _overcast(up: Tensor) -> Tensor:
    return relative_luminance(OVERCAST, up, up) / mean_luminance(OVERCAST, 90)


def _fifth_power(value: Tensor) -> Tensor:
    square = value * value
    return square * square * value
