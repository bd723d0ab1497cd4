"""The light that vehicles send to the camera, one function for each physical term.

A white matt surface on open ground sends 1 in every channel at any elevation of the sun, because
the exposure was set for its light.
"""

import math

import warp as wp

from skyproof.render.lighting import OVERCAST, mean_luminance

# Sharpness of the change from mirrored sky to mirrored ground, around the horizon.
_HORIZON_SHARPNESS = 12.0
# A part of the vehicle that hides the sun also hides the brighter half of a clear sky from surfaces
# that face it. The loss is about that of path tracing between bumps (docs/cycles.md), and that of
# the ground close to a vehicle.
_SHADED_SKY_LOSS = 0.7
# In units of white; path tracing clips single paths at this value, too.
_BRIGHTEST_GLINT = 5.0
_OVERCAST_MEAN = mean_luminance(OVERCAST, 90)
_PI = math.pi


@wp.struct
class SurfaceLight:
    """The light on one vehicle (`lighting`): unit vectors to sun and camera, and channels.

    `sky` and `ground` are what level surfaces receive from each, `strength` what the sun sends
    across its rays. `halving` brings sun plus camera to unit length, `dimming` the clear sky to an
    even one, `gloss` is that of the settings.
    """

    sun: wp.vec3
    viewer: wp.vec3
    sky: wp.vec3
    strength: wp.vec3
    ground: wp.vec3
    sun_and_viewer: float
    halving: float
    overcast: float
    dimming: float
    gloss: float


@wp.func
def arc_cosine(x: float):
    """Returns the arc cosine to within 2e-8 (Abramowitz and Stegun 1964, 4.4.46)."""
    z = wp.abs(x)
    high = 0.0308918810 + z * (-0.0170881256 + z * (0.0066700901 - z * 0.0012624911))
    low = -0.2145988016 + z * (0.0889789874 + z * (-0.0501743046 + z * high))
    angle = wp.sqrt(1.0 - z) * (1.5707963050 + z * low)
    return wp.where(x < 0.0, _PI - angle, angle)


@wp.func
def clear_luminance(up: float, towards_sun: float):
    """CIE standard clear sky, type 12 (ISO 15469:2004), up to a factor, by two cosines."""
    gradation = 1.0 - wp.exp(-0.32 / wp.max(up, 1.0e-2))
    distance = arc_cosine(wp.clamp(towards_sun, -0.9999, 0.9999))
    around = 1.0 + 10.0 * (wp.exp(-3.0 * distance) - wp.exp(-1.5 * _PI))
    return gradation * (around + 0.45 * towards_sun * towards_sun)


@wp.func
def cloudy_luminance(up: float):
    """CIE standard overcast sky, type 1 (ISO 15469:2004), in units of an even sky."""
    return (1.0 + 4.0 * wp.exp(-0.7 / wp.max(up, 1.0e-2))) / _OVERCAST_MEAN


@wp.func
def fresnel_reflectance(reflectance: float, gloss: float, cosine: float):
    """Schlick's approximation (1994), for reflectances up to that of the table of materials.

    Nothing is mirrored where `gloss` and reflectance are 0.
    """
    grazing = wp.max(1.0 - cosine, 0.0)
    square = grazing * grazing
    return reflectance + (gloss - reflectance) * (square * square * grazing)


@wp.func
def glint_lobe(aligned: float, exponent: float):
    """Blinn's lobe (1977) around the direction half-way from the sun to the viewer.

    It is 0 where less than 2.1e-9 is left (log x <= x - 1), without an exponential.
    """
    if exponent * (aligned - 1.0) < -20.0:
        return 0.0
    return wp.exp(exponent * wp.log(wp.max(aligned, 1.0e-6)))


@wp.func
def ground_before(normal: wp.vec3, light: SurfaceLight):
    """Returns light from the ground; the more a surface faces down, the more ground it shades.

    Squared, so that gradients do not jump at level normals.
    """
    turned = wp.min(normal[2], 0.0)
    return light.ground * (1.0 - turned * turned)


@wp.func
def facing_viewer(normal: wp.vec3, light: SurfaceLight):
    """Returns the cosine between normal and viewer, at least 0.

    Interpolated normals may turn away before their faces do. They then count as seen edge-on, or
    sills would mirror the sky.
    """
    return wp.max(wp.dot(normal, light.viewer), 0.0)


@wp.func
def diffuse_light(normal: wp.vec3, sunlit: float, gloss: wp.vec2, light: SurfaceLight):
    """Light of sun, sky and ground that reaches the paint.

    What the clear coat mirrors does not reach it (Fresnel towards the viewer, as path tracers layer
    a coat). `sunlit` is the share of the sun's light that the vehicle itself lets through.
    """
    towards_sun = wp.max(wp.dot(normal, light.sun), 0.0)
    sunny = towards_sun * sunlit
    sky_left = 1.0 - _SHADED_SKY_LOSS * (towards_sun - sunny) * (1.0 - light.overcast)
    open_sky = 0.5 + 0.5 * normal[2]
    diffuse = wp.lerp(ground_before(normal, light), light.sky * sky_left, open_sky)
    kept = 1.0 - fresnel_reflectance(gloss[0], light.gloss, facing_viewer(normal, light))
    return (diffuse + light.strength * sunny) * kept


@wp.func
def mirrored_surroundings(normal: wp.vec3, cosine: float, light: SurfaceLight):
    """Light of the sky or the ground along the mirrored ray, 2 cosine normal - viewer.

    From above, a steep side mirrors the ground, not the sky.
    """
    towards_sun = 2.0 * cosine * wp.dot(normal, light.sun) - light.sun_and_viewer
    up = 2.0 * cosine * normal[2] - light.viewer[2]
    luminance = clear_luminance(up, towards_sun) * light.dimming
    if light.overcast > 0.0:
        luminance = wp.lerp(luminance, cloudy_luminance(up), light.overcast)
    horizon = 1.0 / (1.0 + wp.exp(-_HORIZON_SHARPNESS * up))
    return wp.lerp(ground_before(normal, light), light.sky * luminance, horizon)


@wp.func
def sun_glint(normal: wp.vec3, cosine: float, sunlit: float, gloss: wp.vec2, light: SurfaceLight):
    """The sun mirrored by a rough coat, as Blinn-Phong has it with its peak of (n + 8) / 8.

    A sensor shows it as white long before it ends.
    """
    towards_sun = wp.dot(normal, light.sun)
    sunny = wp.max(towards_sun, 0.0) * sunlit
    if sunny == 0.0:
        return wp.vec3()
    lobe = glint_lobe((towards_sun + cosine) * light.halving, gloss[1])
    peak = gloss[0] * (gloss[1] + 8.0) / 8.0
    return wp.min(light.strength * (peak * lobe * sunny), wp.vec3(_BRIGHTEST_GLINT))


@wp.func
def mirrored_light(normal: wp.vec3, sunlit: float, gloss: wp.vec2, light: SurfaceLight):
    """Light that a coat or pane mirrors; `gloss` is reflectance at normal incidence, exponent."""
    cosine = facing_viewer(normal, light)
    fresnel = fresnel_reflectance(gloss[0], light.gloss, cosine)
    surroundings = mirrored_surroundings(normal, cosine, light)
    return surroundings * fresnel + sun_glint(normal, cosine, sunlit, gloss, light)


@wp.func
def radiance(normal: wp.vec3, albedo: wp.vec3, sunlit: float, gloss: wp.vec2, light: SurfaceLight):
    """Light that a surface sends to the viewer."""
    diffuse = diffuse_light(normal, sunlit, gloss, light)
    return wp.cw_mul(albedo, diffuse) + mirrored_light(normal, sunlit, gloss, light)


@wp.func
def weighted_radiance(
    normal: wp.vec3,
    albedo: wp.vec3,
    sunlit: float,
    gloss: wp.vec2,
    light: SurfaceLight,
    weight: wp.vec3,
):
    """Returns one number, of which Warp derives the gradient in normal and albedo."""
    return wp.dot(weight, radiance(normal, albedo, sunlit, gloss, light))
