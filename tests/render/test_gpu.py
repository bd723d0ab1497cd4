"""One code path for CPU and GPU: the same pictures and gradients on both."""

import dataclasses

import pytest
import torch
from torch.nn.functional import cosine_similarity

from skyproof.geometry.rasterise import rasterise
from skyproof.geometry.triangles import NOTHING_KEY
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.weather import Weather
from skyproof.vehicles.vehicle import Overlay
from tests.render.bodies import PlainGround, rounded_box, scene, smooth_texture, vehicles

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]

HAZY = Light(white=(1.3, 1.2, 1.1), black=(0.03, 0.04, 0.05), shoulder=0.6)


def crowd():
    """Two vehicles that hide each other, one at the border in the rain, and an empty scene."""
    wet = Weather("rain", wetness=0.8, overcast=0.6)
    placements = scene((3.2, -3.0, 250.0), seed=2, name="s1", size_px=64)
    return [
        scene((0.5, 0.2, 20.0), (-1.0, 0.6, 100.0), seed=1, size_px=64),
        dataclasses.replace(placements, weather=wet),
        scene(seed=3, name="s2", size_px=64),
    ]


def coats():
    """Vehicles in textures of their own, in a common one, in bytes, and in a cover over bytes."""
    batch = vehicles(3, seed=3)
    in_bytes = dataclasses.replace(batch, texture=(batch.texture * 255).round().byte())
    masks = torch.rand(3, 512, 512, generator=torch.Generator().manual_seed(0)) < 0.5
    return {
        "own": batch,
        "common": dataclasses.replace(batch, texture=batch.texture[:1], repainted=True),
        "bytes": in_bytes,
        "cover": dataclasses.replace(in_bytes, overlay=Overlay(smooth_texture(7)[0], masks)),
    }


def draw(batch, device, light=None):
    """The frames on a device, and the gradients in textures (None of bytes) and vertices."""
    batch = batch.to(device)
    over = batch.overlay
    shown = (batch.texture if over is None else over.texture).clone()
    shown.requires_grad_(shown.is_floating_point())
    vertices = batch.vertices.clone().requires_grad_()
    painted = {"texture": shown} if over is None else {"overlay": Overlay(shown, over.mask)}
    worn = dataclasses.replace(batch, vertices=vertices, **painted)
    frames = TorchRenderer(PlainGround(None, light=light))(crowd(), worn, masks=True)
    weights = torch.randn(frames.image.shape, generator=torch.Generator().manual_seed(1))
    (frames.image * weights.to(device)).sum().backward()
    return frames, shown.grad, vertices.grad


def cosine(one, other):
    return float(cosine_similarity(one.cpu().flatten(), other.cpu().flatten(), dim=0))


@pytest.mark.parametrize("coat", ["own", "common", "bytes", "cover"])
@pytest.mark.parametrize("light", [None, HAZY], ids=["clear", "hazy"])
def test_the_gpu_draws_what_the_cpu_draws(coat, light):
    frames, *gradients = draw(coats()[coat], "cuda", light)
    expected, *others = draw(coats()[coat], "cpu", light)
    for field in dataclasses.fields(frames):
        assert getattr(frames, field.name).device.type == "cuda", field.name
    difference = (frames.image.cpu() - expected.image).abs()
    # A sample at the edge of a triangle may fall on its other side.
    assert float(difference.median()) < 1e-6
    assert float((difference > 1e-4).float().mean()) < 1e-3
    assert float(difference.max()) < 2e-2
    assert (frames.masks.cpu() != expected.masks).sum() < 5
    torch.testing.assert_close(frames.boxes.cpu(), expected.boxes, atol=1e-3, rtol=0)
    for ours, theirs in zip(gradients, others, strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert ours.device.type == "cuda"
            assert cosine(ours, theirs) > 0.999
            assert float(ours.norm()) == pytest.approx(float(theirs.norm()), rel=1e-2)


def test_samples_are_seen_as_on_the_cpu():
    vertices = rounded_box()[0]
    screen, depth = vertices[None, :, :2] * 20 + 60, -vertices[None, :, 2]
    faces = vehicles().template.faces
    on_gpu = rasterise(screen.cuda(), depth.cuda(), faces.cuda(), 128)
    on_cpu = rasterise(screen, depth, faces, 128)
    assert on_gpu.device.type == "cuda"
    assert int((on_cpu != NOTHING_KEY).sum()) > 1000
    assert float((on_gpu.cpu() != on_cpu).float().mean()) < 1e-3


@torch.no_grad()
def test_pictures_are_the_same_bits_each_time():
    batch = vehicles(3, seed=3).to("cuda")
    one, other = (TorchRenderer(PlainGround(None))(crowd(), batch).image for _ in range(2))
    assert torch.equal(one, other)


def test_gradients_are_nearly_the_same_each_time():
    """Sums on a GPU have no order."""
    _, *first = draw(coats()["own"], "cuda")
    _, *second = draw(coats()["own"], "cuda")
    for one, other in zip(first, second, strict=True):
        assert float((one - other).norm()) < 1e-4 * float(one.norm())


def test_kernels_wait_for_the_work_before_them_on_a_stream_of_its_own():
    batch = vehicles(3, seed=3).to("cuda")
    expected = TorchRenderer(PlainGround(None))(crowd(), batch).image
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        # The texture is ready only long after the call; memory that is given back too early would
        # be written over by what follows.
        busy = torch.rand(4096, 4096, device="cuda")
        for _ in range(20):
            busy = busy @ busy / 4096
        late = torch.where(busy[0, 0] < -1, 0.0, batch.texture)
        worn = dataclasses.replace(batch, texture=late)
        image = TorchRenderer(PlainGround(None))(crowd(), worn).image
        del late, worn
        rubbish = [torch.full_like(batch.texture, 9.0) for _ in range(8)]
        torch.cuda.current_stream().synchronize()
    assert torch.equal(image, expected)
    assert rubbish


def test_a_cover_hides_on_the_gpu_as_on_the_cpu():
    cover = torch.zeros(64, 64)
    cover[:, :32] = 1.0
    ground = PlainGround(None, cover=cover)
    place = scene((0.0, 0.0, 0.0), size_px=64)
    beneath = tuple(dataclasses.replace(each, covered=0.4) for each in place.placements)
    place = dataclasses.replace(place, placements=beneath)
    sharp = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    frames = [
        TorchRenderer(ground, sharp)([place], vehicles().to(device), masks=True)
        for device in ("cpu", "cuda")
    ]
    on_cpu, on_gpu = (each.image[0, :, :, :32].cpu() for each in frames)
    assert torch.equal(on_cpu, on_gpu)
    assert torch.equal(on_cpu, ground.window(place.background, 64)[:, :, :32])
