"""Pyramids of texture: what a sample reads, and where its gradient goes."""

import pytest
import torch

from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.linear_texture import LinearTexture, _Shapes
from skyproof.vehicles.vehicle import Overlay
from tests.render.bodies import smooth_texture

SIDE = 512


def generator(seed):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("finest", [0, 1])
def test_texture_sampling_passes_gradcheck(finest):
    # 128 is the smallest side whose pyramid of seven levels still has texels.
    texture = torch.rand(2, 3, 128, 128, dtype=torch.float64, generator=generator(0)) * 0.8 + 0.1
    patch = texture[:, :, 30:34, 60:64].clone().requires_grad_()
    # Points whose four texels lie within the patch, at three levels, and on both textures.
    uv = torch.tensor(
        [[0.49, 0.25], [0.483, 0.253], [0.49, 0.26], [0.485, 0.247]], dtype=torch.float64
    )
    uv = (uv.t() + 1e-3).requires_grad_()

    def sample(patch, uv):
        filled = texture.clone()
        filled[:, :, 30:34, 60:64] = patch
        return LinearTexture(filled, finest, torch.float64).sample(
            uv, torch.tensor([0, 1, 1, 0]), torch.tensor([0, 0, 1, 2])
        )

    assert torch.autograd.gradcheck(sample, (patch, uv))
    sample(patch, uv).sum().backward()
    assert patch.grad.abs().max() > 0
    assert uv.grad.abs().max() > 0


def test_texture_sampling_is_continuous_across_the_seam_and_held_at_the_ends():
    texture = LinearTexture(smooth_texture(0, size=128).double(), 0, torch.float64)
    u = torch.tensor([1e-9, 1 - 1e-9, 0.3, 0.3, 0.3, 0.3], dtype=torch.float64)
    v = torch.tensor([0.4, 0.4, 0.0, 0.003, 1.0, 0.997], dtype=torch.float64)
    zero = torch.zeros(6, dtype=torch.long)
    sampled = texture.sample(torch.stack((u, v)), zero, zero)
    left, right, nose, near_nose, tail, near_tail = sampled.t()
    torch.testing.assert_close(left, right, atol=1e-6, rtol=0)
    # Half a texel from the end (0.0039) nothing changes any more.
    assert torch.equal(nose, near_nose)
    assert torch.equal(tail, near_tail)


def test_a_coarser_level_holds_the_mean_of_its_texels_in_linear_light():
    stripes = torch.zeros(1, 3, 128, 128, dtype=torch.float64)
    stripes[..., ::2] = 1.0
    sampled = LinearTexture(stripes, 0, torch.float64).sample(
        torch.full((2, 2), 0.5, dtype=torch.float64),
        torch.zeros(2, dtype=torch.long),
        torch.tensor([1, 4]),
    )
    # Half of white and half of black, which reflects 1.5 %.
    torch.testing.assert_close(sampled, torch.full_like(sampled, (1 + 0.015) / 2))


def test_bytes_and_floats_of_one_texture_sample_alike():
    as_bytes = (smooth_texture(1, count=2, size=128) * 255).round().byte()
    as_floats = as_bytes.float() / 255
    uv = torch.rand(2, 50, generator=generator(0))
    index, level = torch.arange(50) % 2, torch.arange(50) % 5
    for finest in (0, 2):
        one = LinearTexture(as_bytes, finest).sample(uv, index, level)
        other = LinearTexture(as_floats, finest).sample(uv, index, level)
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


def painted():
    """A cover under another mask on each of two vehicles, and the vehicles' own paint."""
    own = (smooth_texture(1, count=2, size=SIDE) * 255).round().byte()
    cover = smooth_texture(2, size=SIDE)[0].double()
    return own, cover, torch.rand(2, SIDE, SIDE, generator=generator(3)) < 0.5


def read(texture, levels=5):
    """Samples of every level and both textures."""
    uv = torch.rand(2, 80, generator=generator(0), dtype=torch.float64)
    return texture.sample(uv, torch.arange(80) % 2, torch.arange(80) // 2 % levels)


@pytest.mark.parametrize("finest", [0, 1, 2])
def test_a_cover_reads_and_passes_its_gradient_as_if_it_were_painted_by_hand(finest):
    own, cover, masks = painted()
    one, other = (cover.clone().requires_grad_() for _ in range(2))
    covered = read(LinearTexture(own, finest, torch.float64, Overlay(one, masks)))
    by_hand = torch.where(masks[:, None], other, own.double() / 255)
    expected = read(LinearTexture(by_hand, finest, torch.float64))
    torch.testing.assert_close(covered, expected, atol=1e-12, rtol=0)
    weights = torch.rand(covered.shape, generator=generator(4), dtype=torch.float64)
    for sampled in (covered, expected):
        (sampled * weights).sum().backward()
    torch.testing.assert_close(one.grad, other.grad, atol=1e-12, rtol=0)
    assert one.grad.abs().max() > 0


@pytest.mark.parametrize("finest", [0, 2])
def test_all_textures_at_once_are_as_one_after_the_other(finest, monkeypatch):
    own, cover, masks = painted()

    def drawn():
        over, alone = cover.clone().requires_grad_(), own.double().div(255).requires_grad_()
        textures = [
            LinearTexture(own, finest, torch.float64, Overlay(over, masks)),
            LinearTexture(alone, finest, torch.float64),
            LinearTexture(own, finest, torch.float64),
        ]
        sampled = torch.stack([read(texture) for texture in textures])
        sampled.square().sum().backward()
        return sampled.detach(), over.grad, alone.grad

    one_by_one = drawn()
    # As on a graphics processor.
    monkeypatch.setattr(_Shapes, "some", lambda self, device: [slice(0, self.count)])
    for together, apart in zip(drawn(), one_by_one, strict=True):
        torch.testing.assert_close(together, apart, atol=1e-12, rtol=0)


def test_a_coarse_level_is_the_mean_of_what_lies_under_it():
    texture = smooth_texture(5, size=128).double()
    centre = torch.full((2, 1), 0.5 / 8, dtype=torch.float64)
    zero = torch.zeros(1, dtype=torch.long)
    # The middle of the first of eight times eight texels.
    sampled = LinearTexture(texture, 0, torch.float64).sample(centre, zero, zero + 4)
    mean = 0.015 + 0.985 * srgb_to_linear(texture[0, :, :16, :16]).mean((1, 2))
    torch.testing.assert_close(sampled[:, 0], mean, atol=1e-12, rtol=0)
