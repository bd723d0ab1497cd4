"""The light that surfaces send, and its gradient, against the same formulas in torch."""

import dataclasses
import math

import pytest
import torch
import warp as wp
from torch.nn.functional import normalize

from skyproof.geometry.colour import linear_to_srgb
from skyproof.kernels import launch
from skyproof.render.kernels.light import (
    SurfaceLight,
    diffuse_light,
    mirrored_light,
    weighted_radiance,
)
from skyproof.render.lighting import (
    CLEAR,
    OVERCAST,
    SceneLights,
    lighting,
    mean_luminance,
    relative_luminance,
)
from skyproof.render.materials import gloss_table
from skyproof.render.placed import place
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import CLEAR_SKY
from skyproof.vehicles.vehicle import Part
from tests.render.bodies import scene, vehicles


@wp.kernel(enable_backward=False)
def light_on(
    lights: wp.array(dtype=SurfaceLight),
    vehicle: wp.array(dtype=int),
    normals: wp.array(dtype=wp.vec3),
    sunlit: wp.array(dtype=float),
    gloss: wp.array(dtype=wp.vec2),
    diffuse: wp.array(dtype=wp.vec3),
    mirrored: wp.array(dtype=wp.vec3),
):
    one = wp.tid()
    light = lights[vehicle[one]]
    diffuse[one] = diffuse_light(normals[one], sunlit[one], gloss[one], light)
    mirrored[one] = mirrored_light(normals[one], sunlit[one], gloss[one], light)


# With a way back, or the gradient below would be zero.
@wp.kernel(enable_backward=True)
def radiance_on(
    light: SurfaceLight,
    normals: wp.array(dtype=wp.vec3),
    albedos: wp.array(dtype=wp.vec3),
    sent: wp.array(dtype=float),
):
    one = wp.tid()
    weight = wp.vec3(1.0)
    sent[one] = weighted_radiance(normals[one], albedos[one], 1.0, wp.vec2(), light, weight)


@wp.kernel(enable_backward=False)
def radiance_back(
    lights: wp.array(dtype=SurfaceLight),
    vehicle: wp.array(dtype=int),
    normals: wp.array(dtype=wp.vec3),
    albedos: wp.array(dtype=wp.vec3),
    sunlit: wp.array(dtype=float),
    gloss: wp.array(dtype=wp.vec2),
    weights: wp.array(dtype=wp.vec3),
    to_normals: wp.array(dtype=wp.vec3),
    to_albedos: wp.array(dtype=wp.vec3),
):
    one = wp.tid()
    to_normal, to_albedo, _sunlit, _gloss, _light, _weight = wp.grad(weighted_radiance)(
        normals[one], albedos[one], sunlit[one], gloss[one], lights[vehicle[one]], weights[one]
    )
    to_normals[one] = to_normal
    to_albedos[one] = to_albedo


@dataclasses.dataclass
class Lit:
    """Light on some vehicles: where it comes from, and what is seen from where."""

    sun: torch.Tensor
    viewer: torch.Tensor
    sky: torch.Tensor
    overcast: torch.Tensor
    sunlit: torch.Tensor
    settings: RenderSettings = dataclasses.field(default_factory=RenderSettings)

    def rows(self):
        """As the renderer hands it to its kernels."""
        count = len(self.sun)
        placed = place([scene((0.0, 0.0, 0.0))] * count, vehicles(count))
        placed = dataclasses.replace(
            placed, sun=self.sun, viewer=self.viewer, sunlit=self.sunlit[:, 0]
        )
        ones = torch.ones(count, 3)
        lights = SceneLights(ones, 0 * ones, ones[:, :1], self.sky, self.overcast)
        return lighting(placed, lights, self.settings)

    def drawn(self, normals, vehicle, sunlit, gloss):
        """Diffuse and mirrored light by the renderer's kernels."""
        diffuse, mirrored = torch.empty(2, len(normals), 3)
        given = (self.rows(), vehicle.int(), normals, sunlit, gloss)
        launch(light_on, (len(normals),), *given, diffuse, mirrored)
        return diffuse, mirrored

    def in_torch(self, normals, vehicle, sunlit, gloss):
        """The same in torch, in the precision of its arguments."""
        sun, viewer, sky, overcast, shaded = (
            each.to(normals)[vehicle]
            for each in (self.sun, self.viewer, self.sky, self.overcast, self.sunlit)
        )
        means = [
            mean_luminance(CLEAR, round(math.degrees(math.asin(height))))
            for height in self.sun[:, 2].tolist()
        ]
        direct = (1 - sky) * shaded
        strength = direct / sun[:, 2:]
        down = normals[:, 2:].clamp(max=0.0)
        ground = self.settings.ground_reflectance * (direct + sky) * (1 - down.square())
        towards_sun = (normals * sun).sum(1, keepdim=True)
        facing = towards_sun.clamp(min=0.0)
        sunny = facing * sunlit[:, None]
        hazy = sky * (1 - 0.7 * (facing - sunny) * (1 - overcast))
        diffuse = ground.lerp(hazy, 0.5 + 0.5 * normals[:, 2:]) + strength * sunny
        reflectance, exponent = gloss.to(normals).split(1, dim=1)
        cosine = (normals * viewer).sum(1, keepdim=True).clamp(min=0.0)
        fresnel = reflectance + (self.settings.gloss - reflectance) * (1 - cosine) ** 5
        up = 2 * cosine * normals[:, 2:] - viewer[:, 2:]
        to_sun = 2 * cosine * towards_sun - (sun * viewer).sum(1, keepdim=True)
        clear = relative_luminance(CLEAR, up, to_sun) / normals.new_tensor(means)[vehicle, None]
        cloudy = relative_luminance(OVERCAST, up, up) / mean_luminance(OVERCAST, 90)
        surroundings = ground.lerp(sky * clear.lerp(cloudy, overcast), torch.sigmoid(12 * up))
        aligned = (towards_sun + cosine) / (sun + viewer).norm(dim=1, keepdim=True)
        lobe = aligned.clamp(min=1e-6) ** exponent
        glint = (reflectance * (exponent + 8) / 8 * lobe * sunny * strength).clamp(max=5.0)
        return diffuse * (1 - fresnel), fresnel * surroundings + glint


def clear_day(sun, viewer):
    """A clear day's light on vehicles under such suns."""
    sun, viewer = (normalize(torch.tensor(each), dim=-1) for each in (sun, viewer))
    one = torch.ones(len(sun), 1)
    return Lit(sun, viewer, torch.tensor(CLEAR_SKY).expand(len(sun), 3), 0 * one, one)


def any_day():
    """Three kinds of light, and samples of all parts that look every way."""
    lit = clear_day([[0.6, 0.2, 0.7], [-0.3, 0.9, 0.4], [0.1, 0.1, 1.0]], [[-0.2, 0.1, 0.95]] * 3)
    lit.overcast = torch.tensor([[0.0], [0.5], [1.0]])
    lit.sunlit = torch.tensor([[1.0], [0.4], [0.9]])
    count = 3000
    draw = torch.Generator().manual_seed(1)
    normals = torch.randn(count, 3, generator=draw)
    # As many of them around the glint.
    half_way = normalize(lit.sun + lit.viewer, dim=-1).repeat(count // 6, 1)
    normals[: count // 2] = half_way + 0.1 * normals[: count // 2]
    number = torch.arange(count)
    sunlit = torch.where(torch.rand(count, generator=draw) < 0.3, 0.0, 1.0)
    gloss = gloss_table()[torch.randint(8, (count,), generator=draw)]
    return lit, (normalize(normals, dim=-1), number % 3, sunlit, gloss)


def test_light_is_as_torch_has_it():
    lit, (normals, *where) = any_day()
    # The sharpest lobe multiplies the rounding of its logarithm by 1,500.
    for found, expected in zip(
        lit.drawn(normals, *where), lit.in_torch(normals.double(), *where), strict=True
    ):
        assert float(expected.max()) > 1.0
        torch.testing.assert_close(found.double(), expected, atol=2e-6, rtol=2e-4)


def test_the_gradient_of_light_is_as_torch_has_it():
    lit, (normals, *where) = any_day()
    draw = torch.Generator().manual_seed(2)
    albedos, weights = torch.rand(2, *normals.shape, generator=draw)
    exact = [each.double().requires_grad_() for each in (normals, albedos)]
    diffuse, mirrored = lit.in_torch(exact[0], *where)
    sent = (weights * (exact[1] * diffuse + mirrored)).sum()
    found = torch.zeros(2, *normals.shape)
    vehicle, sunlit, gloss = where
    given = (lit.rows(), vehicle.int(), normals, albedos, sunlit, gloss, weights)
    launch(radiance_back, (len(normals),), *given, *found)
    for ours, theirs in zip(found, torch.autograd.grad(sent, exact), strict=True):
        error = (ours - theirs).norm(dim=1) / theirs.norm(dim=1).clamp(min=0.1)
        assert float(error.max()) < 1e-3


def test_level_ground_sends_as_much_light_as_the_photograph_was_exposed_for():
    up = torch.tensor([[0.0, 0.0, 1.0]])
    level = (up, torch.zeros(1, dtype=torch.long), torch.ones(1))
    for elevation in (0.3, 0.8, 1.5):
        lit = clear_day([[math.cos(elevation), 0.0, math.sin(elevation)]], up.tolist())
        lit.settings = RenderSettings(gloss=0.0)
        matt, mirrored = lit.drawn(*level, gloss_table(0.0)[:1])
        assert matt[0].tolist() == pytest.approx([1.0] * 3, abs=1e-6)
        assert not mirrored.any()
        # What the coat mirrors, seen from straight above, does not reach the paint.
        lit.settings = RenderSettings()
        coated, _ = lit.drawn(*level, gloss_table()[:1])
        assert coated[0].tolist() == pytest.approx([0.982] * 3, abs=1e-6)


@pytest.mark.parametrize("elevation_deg", [30, 45, 60])
def test_black_paint_has_a_sheen_and_no_white_glint(elevation_deg):
    # A quarter of a circle of normals from upright towards the sun, seen from straight above.
    high = math.radians(elevation_deg)
    lit = clear_day([[math.cos(high), 0.0, math.sin(high)]], [[0.0, 0.0, 1.0]])
    leaning = torch.linspace(0.0, math.pi / 2, 91)
    normals = torch.stack((leaning.sin(), 0 * leaning, leaning.cos()), dim=1)
    where = (torch.zeros(91, dtype=torch.long), torch.ones(91), gloss_table()[[Part.BODY] * 91])
    diffuse, mirrored = lit.drawn(normals, *where)
    # Black paint is 1.5 % dust and 0.6 % pigment.
    seen = linear_to_srgb(0.021 * diffuse + mirrored).mean(1)
    mirror_deg = round((90 - elevation_deg) / 2)
    assert float(seen.max()) < 0.6
    assert float(seen[mirror_deg]) > float(seen[0]) + 0.05
    # A round spot would have gone within these degrees.
    assert float(seen[mirror_deg - 5]) > 0.75 * float(seen[mirror_deg])


def test_what_faces_down_sees_its_own_shadow_and_mirrors_no_sky():
    # Sills seen 50 degrees aslant: level sides, and normals that turn under, away from the viewer.
    lit = clear_day([[-0.6, 0.1, 0.8]], [[0.0, -0.77, 0.64]])
    side, under, down = (0.0, -1.0, 0.0), (0.0, -0.3, -0.95), (0.0, 0.0, -1.0)
    normals = normalize(torch.tensor([side, under, down]), dim=-1)
    where = (torch.zeros(3, dtype=torch.long), torch.ones(3))
    matt, mirrored = lit.drawn(normals, *where, gloss_table()[[Part.WHEEL] * 3])
    ground = RenderSettings().ground_reflectance
    assert float(mirrored[1].max()) < 0.2 * ground
    assert not matt[2].any()
    assert float(mirrored[2].max()) < 1e-3
    # A level side has the open ground before it.
    assert float(matt[0].min()) > ground / 2
