"""Gradients against finite differences: texture, light, interior, silhouettes, whole bodies."""

import dataclasses
from functools import lru_cache

import pytest
import torch
from torch.nn.functional import cosine_similarity, interpolate, normalize

from skyproof.render.lighting import Lighting, light
from skyproof.render.materials import gloss_table
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import CLEAR_SKY
from skyproof.vehicles.vehicle import Part
from tests.render.bodies import PlainGround, double, scene, vehicles

SIZE = 64
GROUND = PlainGround(0.4, torch.float64)


def generator(seed):
    return torch.Generator().manual_seed(seed)


def normal(*shape, seed):
    return torch.randn(*shape, dtype=torch.float64, generator=generator(seed))


def test_light_passes_gradcheck_in_the_normal():
    upward = normalize(normal(3, 6, seed=1) + torch.tensor([[0.0], [0.0], [2.0]]), dim=0)
    upward = upward.requires_grad_()
    sun = normalize(torch.tensor([[0.6, 0.2, 0.7]], dtype=torch.float64), dim=-1)
    viewer = normalize(torch.tensor([[-0.2, 0.1, 0.95]], dtype=torch.float64), dim=-1)
    finish = gloss_table()[:6].double().t()
    sunlit = torch.tensor([1.0, 0.0, 1.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    given = lighting_from(sun, viewer)
    vehicle = torch.zeros(6, dtype=torch.long)
    assert torch.autograd.gradcheck(
        lambda n: light(n, given, vehicle, sunlit, finish, RenderSettings()), upward
    )


def test_level_ground_sends_as_much_light_as_the_photograph_was_exposed_for():
    up = torch.tensor([[0.0, 0.0, 1.0]])
    vehicle = torch.zeros(1, dtype=torch.long)
    body = gloss_table().t()[:, :1]
    for elevation in (0.3, 0.8, 1.5):
        sun = torch.tensor(
            [[float(torch.tensor(elevation).cos()), 0.0, float(torch.tensor(elevation).sin())]]
        )
        given = lighting_from(sun, up)
        matt_finish = gloss_table(0.0).t()[:, :1]
        matt, mirrored = light(
            up.t(), given, vehicle, torch.ones(1), matt_finish, RenderSettings(gloss=0.0)
        )
        assert matt[:, 0].tolist() == pytest.approx([1.0] * 3, abs=1e-6)
        assert not mirrored.any()
        # What the coat mirrors, seen from straight above, does not reach the paint.
        coated, _ = light(up.t(), given, vehicle, torch.ones(1), body, RenderSettings())
        assert coated[:, 0].tolist() == pytest.approx([0.96] * 3, abs=1e-6)


def test_what_faces_down_sees_its_own_shadow_and_mirrors_no_sky():
    # Sills seen 50 degrees aslant: level sides, and normals that turn under, away from the viewer.
    viewer = normalize(torch.tensor([[0.0, -0.77, 0.64]]), dim=-1)
    sun = normalize(torch.tensor([[-0.6, 0.1, 0.8]]), dim=-1)
    side, under, down = (0.0, -1.0, 0.0), (0.0, -0.3, -0.95), (0.0, 0.0, -1.0)
    normals = normalize(torch.tensor([side, under, down]), dim=-1).t()
    matt, mirrored = light(
        normals,
        lighting_from(sun, viewer),
        torch.zeros(3, dtype=torch.long),
        torch.ones(1),
        gloss_table().t()[:, [Part.WHEEL] * 3],
        RenderSettings(),
    )
    ground = RenderSettings().ground_reflectance
    assert float(mirrored[:, 1].max()) < 0.2 * ground
    assert not matt[:, 2].any()
    assert float(mirrored[:, 2].max()) < 1e-3
    # A level side has the open ground before it.
    assert float(matt[:, 0].min()) > ground / 2


def lighting_from(sun, viewer):
    """A clear day's light on as many vehicles."""
    one = torch.ones_like(sun[:, :1])
    return Lighting(sun, viewer, sun.new_tensor(CLEAR_SKY).expand_as(sun), 0 * one, one, one)


def test_the_image_is_differentiable_in_the_texture():
    batch = double(vehicles(2, seed=4))
    renderer = TorchRenderer(GROUND)
    scenes = [
        scene((0.3, -0.2, 40.0), size_px=SIZE),
        scene((0.0, 0.1, 250.0), size_px=SIZE, name="s1"),
    ]
    weights = normal(2, 3, SIZE, SIZE, seed=2)

    def value(texture):
        return (renderer(scenes, dataclasses.replace(batch, texture=texture)).image * weights).sum()

    texture = batch.texture.clone().requires_grad_()
    value(texture).backward()
    for seed in range(3):
        direction = normal(*texture.shape, seed=10 + seed)
        analytic = float((texture.grad * direction).sum())
        with torch.no_grad():
            step = 1e-5
            numeric = float(
                value(texture + step * direction) - value(texture - step * direction)
            ) / (2 * step)
        assert analytic == pytest.approx(numeric, rel=1e-5)


def smooth_field(base, seed):
    """A displacement outward or inward that varies slowly over the body."""
    draw = generator(seed)
    wave = torch.randn(6, 3, dtype=torch.float64, generator=draw) * 1.2
    phase = torch.rand(6, dtype=torch.float64, generator=draw) * 6.28
    size = torch.randn(6, dtype=torch.float64, generator=draw)
    return outward(base) * (torch.sin(base @ wave.T + phase) * size).sum(-1, keepdim=True) / 2


def outward(base):
    return normalize(base - base.mean(1, keepdim=True), dim=-1)


def shift(base, angle_deg):
    angle = torch.deg2rad(torch.tensor(float(angle_deg), dtype=torch.float64))
    return torch.stack((angle.cos(), angle.sin(), angle * 0)).expand_as(base)


def test_inside_the_body_every_pixel_follows_the_vertices():
    # No blur: pixels that the body covers fully before and after depend on shading and texture
    # alone.
    renderer = TorchRenderer(GROUND, RenderSettings(blur_sigma_px=0.0, noise=0.0))
    batch = double(vehicles(1, seed=3))
    place = [scene((0.2, -0.1, 33.0), size_px=SIZE, tilt_deg=8.0)]
    base = batch.vertices

    def image(vertices):
        return renderer(place, dataclasses.replace(batch, vertices=vertices)).image

    direction = smooth_field(base, 5)
    vertices = base.clone().requires_grad_()
    # The product of the Jacobian with a direction, by transposing the transposed product.
    probe = torch.zeros(1, 3, SIZE, SIZE, dtype=torch.float64, requires_grad=True)
    (pulled,) = torch.autograd.grad(image(vertices), vertices, probe, create_graph=True)
    (analytic,) = torch.autograd.grad((pulled * direction).sum(), probe)
    with torch.no_grad():
        step = 1e-7
        numeric = (image(base + step * direction) - image(base - step * direction)) / (2 * step)
        held = renderer(place, batch, masks=True).masks
    interior = -torch.nn.functional.max_pool2d(-held[:, None].double(), 5, stride=1, padding=2)
    interior = (interior > 0)[:, 0]
    assert interior.sum() > 200
    analytic, numeric = analytic[0][:, interior[0]], numeric[0][:, interior[0]]
    assert numeric.abs().median() > 0.01
    error = (analytic - numeric).abs() / numeric.abs().clamp(min=0.05 * numeric.abs().max())
    assert error.max() < 1e-3


PLACES = [(-0.4, -0.3, 20.0), (0.3, 0.2, 77.0), (0.1, -0.1, 141.0)]


@lru_cache
def agreement(kind, uniform):
    """Returns cosine and slope of autograd at 4x against central differences at 16x."""

    def renderer(factor):
        settings = RenderSettings(factor, factor, noise=0.0, gloss=0.0 if uniform else 1.0)
        return TorchRenderer(GROUND, settings)

    batch = double(vehicles(1, seed=3))
    if uniform:
        batch = dataclasses.replace(batch, texture=torch.full_like(batch.texture, 0.8))
    base = batch.vertices
    directions = {
        "smooth": [smooth_field(base, seed) for seed in range(3)],
        "inflate": [outward(base)],
        "scale": [base],
        "shift": [shift(base, angle) for angle in (10, 130)],
    }[kind]
    pairs = []
    for number, where in enumerate(PLACES):
        place = [scene(where, size_px=SIZE, tilt_deg=6.0 * number)]
        coarse = normal(5, 3, 8, 8, seed=20 + number)
        weights = interpolate(coarse, size=SIZE, mode="bicubic", align_corners=False)
        vertices = base.clone().requires_grad_()
        drawn = renderer(4)(place, dataclasses.replace(batch, vertices=vertices)).image
        gradients = [
            torch.autograd.grad((drawn[0] * weight).sum(), vertices, retain_graph=True)[0]
            for weight in weights
        ]
        with torch.no_grad():
            step = 0.01
            for direction in directions:
                ahead, back = (
                    renderer(16)(
                        place, dataclasses.replace(batch, vertices=base + sign * step * direction)
                    ).image
                    for sign in (1, -1)
                )
                change = (ahead - back)[0] / (2 * step)
                pairs += [
                    (float((gradient * direction).sum()), float((change * weight).sum()))
                    for gradient, weight in zip(gradients, weights, strict=True)
                ]
    analytic, numeric = torch.tensor(pairs, dtype=torch.float64).T
    cosine = float(cosine_similarity(analytic, numeric, 0))
    return cosine, float((analytic * numeric).sum() / numeric.square().sum())


def test_silhouettes_of_a_plain_body_follow_the_vertices():
    cosine, slope = agreement("smooth", uniform=True)
    assert cosine >= 0.95, (cosine, slope)
    assert 0.8 <= slope <= 1.2, (cosine, slope)


@pytest.mark.parametrize("kind", ["smooth", "inflate", "scale", "shift"])
def test_a_textured_body_and_its_shadow_follow_motions_of_the_whole_body(kind):
    cosine, slope = agreement(kind, uniform=False)
    assert cosine >= 0.95, (cosine, slope)
    assert 0.8 <= slope <= 1.25, (cosine, slope)


def test_without_the_silhouette_term_the_gradient_would_be_wrong(monkeypatch):
    # Guards the tests above against a weak measure: they must be able to tell.
    from skyproof.render import layers

    monkeypatch.setattr(
        layers, "_edges", lambda visibility, points, colour, edge_colour, factor: 0.0
    )
    cosine, slope = agreement.__wrapped__("smooth", uniform=True)
    assert cosine < 0.8 or not 0.8 <= slope <= 1.2, (cosine, slope)
