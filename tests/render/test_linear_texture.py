"""Pyramids of texture: what a sample reads, and where its gradient goes."""

import pytest
import torch
import warp as wp
from torch.nn.functional import avg_pool2d

from skyproof.geometry.colour import srgb_to_linear
from skyproof.kernels import launch
from skyproof.render.kernels.surface import albedo_of, texels_around
from skyproof.render.kernels.surface_gradients import add_texels
from skyproof.render.kernels.texture import LEVELS, Pyramid
from skyproof.render.linear_texture import LinearTexture
from tests.render.bodies import smooth_texture

SIDE = 512


@wp.kernel(enable_backward=False)
def read_points(
    pyramid: Pyramid,
    vehicle: wp.array(dtype=int),
    level: wp.array(dtype=int),
    uvs: wp.array(dtype=wp.vec2),
    found: wp.array(dtype=wp.vec3),
):
    point = wp.tid()
    found[point] = albedo_of(
        pyramid, texels_around(pyramid, vehicle[point], uvs[point], level[point])
    )


@wp.kernel(enable_backward=False)
def read_points_back(
    pyramid: Pyramid,
    vehicle: wp.array(dtype=int),
    level: wp.array(dtype=int),
    uvs: wp.array(dtype=wp.vec2),
    given: wp.array(dtype=wp.vec3),
    to_texels: wp.array(dtype=wp.vec3),
):
    point = wp.tid()
    at = texels_around(pyramid, vehicle[point], uvs[point], level[point])
    add_texels(to_texels, at, given[point])


def generator(seed):
    return torch.Generator().manual_seed(seed)


def points(uv, vehicle=0, level=0):
    """Vehicle, level and place of points, as the kernels take them."""
    uvs = torch.as_tensor(uv, dtype=torch.float32).contiguous()
    each = torch.zeros(len(uvs), dtype=torch.int32)
    indices, levels = ((each + torch.as_tensor(some)).int() for some in (vehicle, level))
    return indices, levels, uvs


def many_points(count=400, levels=LEVELS):
    """Points of every level on both textures, some of them at the ends of the map."""
    uv = torch.rand(count, 2, generator=generator(0))
    uv[:40] = (uv[:40] * 3).round() / 3
    number = torch.arange(count)
    return points(uv, number % 2, number // 2 % levels)


def read(pyramid, where):
    found = torch.empty(len(where[2]), 3)
    launch(read_points, (len(found),), pyramid.pyramid, *where, found)
    return found


def read_back(pyramid, where, given, shape):
    """The gradient of the shown texture from that of what was read."""
    to_texels = torch.zeros_like(pyramid.texels)
    launch(read_points_back, (len(given),), pyramid.pyramid, *where, given, to_texels)
    return pyramid.back(to_texels, torch.Size(shape))


def in_torch(textures, finest, where):
    """Bilinear samples of mean reflectances, circular in u and held in v, with autograd."""
    levels = [0.015 + 0.985 * srgb_to_linear(textures)]
    for _ in range(LEVELS - 1):
        levels.append(avg_pool2d(levels[-1], 2))
    vehicle, level, uvs = where
    found = []
    for index, wanted, (u, v) in zip(vehicle, level, uvs.double(), strict=True):
        texels = levels[max(int(wanted), finest)][int(index) % len(textures)]
        side = texels.shape[-1]
        x, y = u * side - 0.5, v * side - 0.5
        left, top = int(x.floor()), int(y.floor())
        across, down = x - left, y - top
        total = 0.0
        for row, share in ((top, 1 - down), (top + 1, down)):
            line = texels[:, min(max(row, 0), side - 1)]
            mean = line[:, left % side] * (1 - across) + line[:, (left + 1) % side] * across
            total = total + share * mean
        found.append(total)
    return torch.stack(found)


@pytest.mark.parametrize("finest", [0, 1, 2, 6])
@pytest.mark.parametrize("count", [1, 2])
def test_samples_and_their_gradient_are_as_torch_has_them(finest, count):
    texture = smooth_texture(1, count=count, size=128) * 0.9 + 0.1 * torch.rand(
        count, 3, 128, 128, generator=generator(5)
    )
    where, exact = many_points(), texture.double().requires_grad_()
    ours = LinearTexture(texture, finest)
    expected = in_torch(exact, finest, where)
    torch.testing.assert_close(read(ours, where).double(), expected.detach(), atol=1e-6, rtol=0)
    given = torch.rand(expected.shape, generator=generator(4)) - 0.5
    found = read_back(ours, where, given, texture.shape)
    (gradient,) = torch.autograd.grad((expected * given).sum(), exact)
    assert all(gradient.flatten(1).abs().amax(1) > 0)
    error = (found - gradient).abs() / gradient.abs().clamp(min=1e-3 * float(gradient.abs().max()))
    assert float(error.max()) < 1e-4


def test_texture_sampling_is_continuous_across_the_seam_and_held_at_the_ends():
    texture = LinearTexture(smooth_texture(0, size=128), 0)
    u = torch.tensor([1e-7, 1 - 1e-7, 0.3, 0.3, 0.3, 0.3])
    v = torch.tensor([0.4, 0.4, 0.0, 0.003, 1.0, 0.997])
    left, right, nose, near_nose, tail, near_tail = read(texture, points(torch.stack((u, v), 1)))
    torch.testing.assert_close(left, right, atol=1e-6, rtol=0)
    # Half a texel from the end (0.0039) nothing changes any more.
    assert torch.equal(nose, near_nose)
    assert torch.equal(tail, near_tail)


def test_a_coarser_level_holds_the_mean_of_its_texels_in_linear_light():
    stripes = torch.zeros(1, 3, 128, 128)
    stripes[..., ::2] = 1.0
    for finest in (0, 1):
        sampled = read(
            LinearTexture(stripes, finest), points(torch.full((2, 2), 0.5), level=[1, 4])
        )
        # Half of white and half of black, which reflects 1.5 %.
        torch.testing.assert_close(sampled, torch.full_like(sampled, (1 + 0.015) / 2))


def test_a_coarse_level_is_the_mean_of_what_lies_under_it():
    texture = smooth_texture(5, size=128)
    mean = 0.015 + 0.985 * srgb_to_linear(texture[0, :, :16, :16].double()).mean((1, 2))
    for finest in (0, 1, 2):
        # The middle of the first of eight times eight texels.
        sampled = read(LinearTexture(texture, finest), points(torch.full((1, 2), 0.5 / 8), level=4))
        torch.testing.assert_close(sampled[0].double(), mean, atol=5e-7, rtol=0)


def test_bytes_and_floats_of_one_texture_sample_alike():
    as_bytes = (smooth_texture(1, count=2, size=128) * 255).round().byte()
    # Every value, the dark ones included.
    as_bytes.view(-1)[:256] = torch.arange(256, dtype=torch.uint8)
    as_floats = as_bytes.float() / 255
    for finest in (0, 1, 2):
        one, other = (LinearTexture(each, finest) for each in (as_bytes, as_floats))
        torch.testing.assert_close(one.texels, other.texels, atol=1e-6, rtol=0)
        where = many_points()
        torch.testing.assert_close(read(one, where), read(other, where), atol=5e-7, rtol=0)


def painted():
    """A cover under another mask on each of two vehicles, and the vehicles' own paint."""
    own = (smooth_texture(1, count=2, size=SIDE) * 255).round().byte()
    cover = smooth_texture(2, size=SIDE)[0]
    return own, cover, torch.rand(2, SIDE, SIDE, generator=generator(3)) < 0.5


@pytest.mark.parametrize("finest", [0, 1, 2])
def test_a_cover_reads_and_passes_its_gradient_as_if_it_were_painted_by_hand(finest):
    own, cover, masks = painted()
    covered = LinearTexture(cover[None], finest, own, masks)
    by_hand = LinearTexture(torch.where(masks[:, None], cover, own.float() / 255), finest)
    where = many_points()
    torch.testing.assert_close(read(covered, where), read(by_hand, where), atol=5e-7, rtol=0)
    given = torch.rand(len(where[2]), 3, generator=generator(4))
    found = read_back(covered, where, given, (1, *cover.shape))[0]
    each = read_back(by_hand, where, given, (2, *cover.shape))
    expected = (each * masks[:, None]).sum(0)
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("finest", [0, 1, 2])
def test_each_texture_of_a_batch_is_as_it_is_alone(finest):
    own, cover, masks = painted()
    vehicle, level, uvs = where = many_points()
    given = torch.rand(len(uvs), 3, generator=generator(4))
    floats = own.float() / 255
    together, covered = (
        LinearTexture(floats, finest),
        LinearTexture(cover[None], finest, own, masks),
    )
    gradient = read_back(together, where, given, own.shape)
    for index in range(2):
        rows = torch.nonzero(vehicle == index)[:, 0]
        there = points(uvs[rows], 0, level[rows])
        single = slice(index, index + 1)
        alone = LinearTexture(floats[single], finest)
        assert torch.equal(read(together, where)[rows], read(alone, there))
        assert torch.equal(gradient[single], read_back(alone, there, given[rows], own[:1].shape))
        under = LinearTexture(cover[None], finest, own[single], masks[single])
        assert torch.equal(read(covered, where)[rows], read(under, there))


def test_a_texel_that_is_no_number_makes_none_of_all_that_are_read_from_it():
    texture = smooth_texture(0, size=128)
    texture[:, :, 5, 9] = torch.nan
    pyramid = LinearTexture(texture, 0)
    held = [pyramid.texels[: 128**2], pyramid.texels[128**2 :][: 64**2]]
    for side, texels, place in ((128, held[0], (5, 9)), (64, held[1], (2, 4))):
        expected = torch.zeros(side, side, 3, dtype=torch.bool)
        expected[place] = True
        assert torch.equal(texels.view(side, side, 3).isnan(), expected)
