"""Compositing and blur against separate implementations in NumPy and torch (section S2.1)."""

import math

import numpy as np
import pytest
import torch

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.composite import composite
from skyproof.render.layers import WindowLayers
from skyproof.render.lighting import scene_lights
from skyproof.render.placed import Windows
from skyproof.render.sensor import noise_tiles
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.sensor import Sensor
from tests.render.bodies import scene

# Kernels work in 32 bits, and read linear light from a table; it is least exact where sRGB turns
# from a line to a power.
ROUNDING = 5e-6
LIGHT = Light()
SKY = np.array(LIGHT.sky)[:, None, None]


def to_linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear):
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def blurred(picture, sigma_px):
    """Applies a kernel of k x k, k = 6 ceil(sigma) - 1, by adding shifted copies."""
    side = 6 * math.ceil(sigma_px) - 1
    steps = np.arange(side) - side // 2
    kernel = np.exp(-(steps[:, None] ** 2 + steps[None, :] ** 2) / (2 * sigma_px**2))
    kernel /= kernel.sum()
    height, width = picture.shape[1:]
    padded = np.pad(picture, ((0, 0), (side // 2, side // 2), (side // 2, side // 2)))
    total = np.zeros_like(picture)
    for row in range(side):
        for column in range(side):
            total += kernel[row, column] * padded[:, row : row + height, column : column + width]
    return total


def place(canvas, layer, left, top, margin):
    size = layer.shape[-1]
    canvas[:, top + margin : top + margin + size, left + margin : left + margin + size] = layer


def by_hand(photograph, body, body_at, shadow, shadow_at, settings, margin=40):
    """Hides the photograph by blurred coverage, on a canvas that repeats its edge pixels."""
    size = photograph.shape[-1]
    ground = to_linear(
        np.pad(photograph, ((0, 0), (margin, margin), (margin, margin)), mode="edge")
    )
    drawn, shade = np.zeros((4, *ground.shape[1:])), np.zeros((2, *ground.shape[1:]))
    place(drawn, body, *body_at, margin)
    place(shade, shadow, *shadow_at, margin)
    drawn, shade = blurred(drawn, settings.blur_sigma_px), blurred(shade, settings.blur_sigma_px)
    mixed = to_srgb(
        ground * (1 - (1 - SKY) * shade[:1] - SKY * shade[1:]) * (1 - drawn[3]) + drawn[:3]
    )
    return mixed[:, margin : margin + size, margin : margin + size]


def test_on_even_ground_the_blur_is_the_papers():
    """I = I_bg + G(I_fg - I_bg) (section S2.1); ours differs only where the ground has detail."""
    settings = RenderSettings(blur_sigma_px=2.4, noise=0.0)
    photograph, body = torch.full((1, 3, 48, 48), 0.4, dtype=torch.float64), layer(11, 1)
    image = compose(
        photograph, body, [(18, 20)], torch.zeros(1, 2, 3, 3).double(), [(20, 20)], settings
    )
    ground, drawn = to_linear(photograph[0].numpy()), np.zeros((4, 48, 48))
    place(drawn, body[0].numpy(), 18, 20, 0)
    front = ground * (1 - drawn[3]) + drawn[:3]
    expected = to_srgb(ground + blurred(front - ground, settings.blur_sigma_px))
    np.testing.assert_allclose(image[0].numpy(), expected, atol=1e-6)


def test_markings_do_not_shine_through_a_vehicle():
    photograph = torch.full((1, 3, 64, 64), 0.3, dtype=torch.float64)
    photograph[..., 31:33] = 0.95
    body = torch.cat((torch.full((3, 40, 40), 0.2), torch.ones(1, 40, 40))).double()[None]
    no_shadow, settings = (
        torch.zeros(1, 2, 3, 3).double(),
        RenderSettings(blur_sigma_px=2.4, noise=0.0),
    )
    image = compose(photograph, body, [(12, 12)], no_shadow, [(20, 20)], settings)
    middle = image[0, :, 28:36, 20:44]
    assert float(middle.max() - middle.min()) < 1e-3


def layer(size, seed):
    draw = torch.Generator().manual_seed(seed)
    coverage = torch.rand(1, size, size, dtype=torch.float64, generator=draw)
    return torch.cat(
        (torch.rand(3, size, size, dtype=torch.float64, generator=draw) * coverage, coverage)
    )[None]


def compose(
    photograph,
    bodies,
    body_at,
    shadows,
    shadow_at,
    settings,
    scenes=(0,),
    nearness=(0.0,),
    seeds=(0,),
    light=LIGHT,
):
    photograph = photograph.float()
    layers = [
        WindowLayers(
            Windows(torch.tensor(at), values.shape[-1]),
            values.permute(0, 2, 3, 1).float().contiguous(),
        )
        for at, values in ((body_at, bodies), (shadow_at, shadows))
    ]
    return composite(
        photograph.clone(),
        bodies=layers[0],
        shadows=layers[1],
        scene=torch.tensor(scenes),
        nearness=torch.tensor(nearness),
        seeds=list(seeds),
        lights=scene_lights([light] * len(photograph), [scene()] * len(photograph), photograph),
        sensors=[settings.sensor_on(Sensor(), 0.125)] * len(photograph),
    ).double()


def noise_photograph(count=1, size=48, seed=9):
    drawn = torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(seed))
    return drawn.double()


@pytest.mark.parametrize("sigma_px", [2.4, 1.0, 0.6])
@pytest.mark.parametrize("body_at", [(17, 20), (-5, 40)])
def test_a_hand_made_layer_is_composited_as_numpy_does(sigma_px, body_at):
    settings = RenderSettings(blur_sigma_px=sigma_px, noise=0.0)
    photograph, body, shadow = noise_photograph(), layer(11, 1), layer(13, 2)[:, 2:]
    shadow_at = (body_at[0] + 4, body_at[1] - 6)
    image = compose(photograph, body, [body_at], shadow, [shadow_at], settings)
    expected = by_hand(
        photograph[0].numpy(), body[0].numpy(), body_at, shadow[0].numpy(), shadow_at, settings
    )
    np.testing.assert_allclose(image[0].numpy(), expected, atol=ROUNDING)


@pytest.mark.parametrize(("sigma_px", "side"), [(2.4, 17), (1.0, 5), (3.2, 23), (0.0, 1)])
def test_one_pixel_spreads_over_the_papers_kernel_and_no_further(sigma_px, side):
    # White on black: what arrives is the kernel itself.
    settings = RenderSettings(blur_sigma_px=sigma_px, noise=0.0)
    photograph = torch.zeros(1, 3, 48, 48, dtype=torch.float64)
    dot, nothing = (
        torch.ones(1, 4, 1, 1, dtype=torch.float64),
        torch.zeros(1, 2, 1, 1, dtype=torch.float64),
    )
    image = compose(photograph, dot, [(24, 24)], nothing, [(24, 24)], settings)
    reached = image[0, 0] > 0
    rows, columns = reached.any(1).nonzero()[:, 0], reached.any(0).nonzero()[:, 0]
    assert (rows.tolist(), columns.tolist()) == ([*range(24 - side // 2, 25 + side // 2)],) * 2
    assert to_linear(image[0].numpy()).sum() == pytest.approx(3.0, abs=1e-6)


def test_pixels_that_nothing_reaches_keep_the_photographs_bits():
    settings = RenderSettings(blur_sigma_px=2.4)
    photograph = noise_photograph()
    # WindowLayers with an empty rim: its pixels are computed, and must come out as they were.
    body, shadow = (torch.nn.functional.pad(layer(9, seed), (6, 6, 6, 6)) for seed in (1, 2))
    image = compose(photograph, body, [(14, 14)], shadow[:, 2:], [(14, 14)], settings)
    untouched = torch.ones(48, 48, dtype=torch.bool)
    untouched[12:37, 12:37] = False
    assert torch.equal(image[0][:, untouched], photograph[0][:, untouched])
    assert (image != photograph)[0, :, 14:35, 14:35].float().mean() > 0.99


def test_full_shadow_leaves_its_light_of_each_channel():
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    photograph = noise_photograph()
    nothing = torch.zeros(1, 4, 1, 1, dtype=torch.float64)
    shade = torch.ones(1, 2, 10, 10, dtype=torch.float64)
    shade[:, 1] = 0.0
    light = Light(sky=(0.3, 0.2, 0.5))
    image = compose(photograph, nothing, [(5, 5)], shade, [(10, 12)], settings, light=light)
    shaded = to_linear(image[0, :, 12:22, 10:20].numpy())
    open_ground = to_linear(photograph[0, :, 12:22, 10:20].numpy())
    np.testing.assert_allclose(
        shaded, np.array([0.3, 0.2, 0.5])[:, None, None] * open_ground, atol=5e-7
    )


@pytest.mark.parametrize("nearness", [(1.0, 0.0), (0.0, 1.0)])
def test_the_nearer_vehicle_hides_the_farther_one(nearness):
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    red, blue = torch.zeros(2, 4, 8, 8, dtype=torch.float64)
    red[[0, 3]], blue[[2, 3]] = 1.0, 1.0
    nothing = torch.zeros(2, 2, 1, 1, dtype=torch.float64)
    image = compose(
        noise_photograph(),
        torch.stack((red, blue)),
        [(10, 10), (14, 12)],
        nothing,
        [(10, 10)] * 2,
        settings,
        scenes=(0, 0),
        nearness=nearness,
    )
    both = image[0, :, 12:18, 14:18]
    expected = [1.0, 0.0, 0.0] if nearness[0] > nearness[1] else [0.0, 0.0, 1.0]
    torch.testing.assert_close(
        both, torch.tensor(expected, dtype=torch.float64)[:, None, None].expand_as(both)
    )


def test_two_shadows_on_one_place_shade_it_once():
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    photograph, nothing = noise_photograph(), torch.zeros(2, 4, 1, 1, dtype=torch.float64)
    shade = torch.ones(2, 2, 6, 6, dtype=torch.float64)
    shade[:, 1] = 0.0
    twice = compose(
        photograph, nothing, [(0, 0)] * 2, shade, [(10, 10)] * 2, settings, (0, 0), (0.0, 1.0)
    )
    once = compose(photograph, nothing[:1], [(0, 0)], shade[:1], [(10, 10)], settings)
    assert torch.equal(once, twice)


def test_vehicles_land_in_their_own_image():
    settings = RenderSettings(blur_sigma_px=2.4, noise=0.0)
    photographs, bodies = noise_photograph(3), torch.cat((layer(9, 1), layer(9, 2), layer(9, 3)))
    shadows = torch.zeros(3, 2, 9, 9, dtype=torch.float64)
    at = [(5, 5), (30, 8), (12, 28)]
    image = compose(
        photographs, bodies, at, shadows, at, settings, (2, 0, 2), (0.0, 0.0, 1.0), (1, 2, 3)
    )
    assert torch.equal(image[1], photographs[1])
    alone = compose(photographs[:1], bodies[1:2], at[1:2], shadows[:1], at[1:2], settings)
    assert torch.equal(image[:1], alone)


def test_noise_lies_on_rendered_pixels_with_the_strength_asked_for():
    settings = RenderSettings(noise=0.02, blur_sigma_px=1.0)
    photograph = torch.full((1, 3, 96, 96), 0.5, dtype=torch.float64)
    body = torch.ones(1, 4, 60, 60, dtype=torch.float64) * 0.2
    body[:, 3] = 1.0
    nothing = torch.zeros(1, 2, 1, 1, dtype=torch.float64)
    image = compose(photograph, body, [(18, 18)], nothing, [(18, 18)], settings, seeds=(4,))
    inside, other = (
        image[0, :, 25:70, 25:70],
        compose(photograph, body, [(18, 18)], nothing, [(0, 0)], settings),
    )
    assert float(inside.std()) == pytest.approx(0.02, rel=0.05)
    assert not torch.equal(image, other), "another seed was meant to give other noise"
    assert torch.equal(image[0, :, :10], photograph[0, :, :10])


HAZY = Light(white=(1.3, 1.2, 1.1), black=(0.03, 0.04, 0.05), shoulder=0.6)


def test_a_vehicle_is_shown_between_the_photographs_black_and_white():
    """A black body is as dark as the haze, a white one burns out, a grey one is bent by neither."""
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    nothing = torch.zeros(1, 2, 1, 1, dtype=torch.float64)
    for value, expected in ((0.0, (0.03, 0.04, 0.05)), (0.3, (0.411, 0.388, 0.365))):
        body = torch.full((1, 4, 8, 8), value, dtype=torch.float64)
        body[:, 3] = 1.0
        image = compose(
            noise_photograph(), body, [(10, 10)], nothing, [(10, 10)], settings, light=HAZY
        )
        shown = to_linear(image[0, :, 12:16, 12:16].numpy())
        np.testing.assert_allclose(shown, np.broadcast_to(expected, (4, 4, 3)).T, atol=1e-6)
    body = torch.ones(1, 4, 8, 8, dtype=torch.float64)
    image = compose(noise_photograph(), body, [(10, 10)], nothing, [(10, 10)], settings, light=HAZY)
    red = to_linear(image[0, 0, 12:16, 12:16].numpy())
    np.testing.assert_allclose(red, 0.6 + 0.4 * math.tanh(0.7 / 0.4), atol=1e-6)


def test_light_is_got_back_from_how_it_is_shown():
    lights = scene_lights([HAZY], [scene()], torch.zeros(1, dtype=torch.float64))
    light = torch.linspace(0, 1, 50, dtype=torch.float64).view(1, 1, 5, 10).expand(1, 3, 5, 10)
    torch.testing.assert_close(lights.received(lights.shown(light)), light, atol=1e-9, rtol=0)
    # What is shown as white is not taken for endless light.
    assert float(lights.received(torch.ones_like(light)).max()) < 2.0


def test_a_breath_of_shadow_leaves_what_the_photograph_shows():
    """The light behind each value is got back, and shown as before."""
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    photograph, nothing = noise_photograph(), torch.zeros(1, 4, 1, 1)
    shade = torch.full((1, 2, 48, 48), 1e-9)
    for light, least, most in ((LIGHT, (0.0,) * 3, 1.0), (HAZY, HAZY.black, 0.992)):
        image = compose(photograph, nothing, [(0, 0)], shade, [(0, 0)], settings, light=light)
        assert not torch.equal(image, photograph)
        # Nothing is darker than the haze, and what burnt out is not taken for endless light.
        shown = to_linear(photograph[0].numpy())
        expected = to_srgb(np.clip(shown, np.array(least)[:, None, None], most))
        np.testing.assert_allclose(image[0].numpy(), expected, atol=ROUNDING)


def in_torch(photographs, bodies, body_at, shadows, shadow_at, settings, scenes, nearness, light):
    """The formula of section S2.1 with autograd, image by image, on canvases with a wide rim."""
    size, rim = photographs.shape[-1], 40
    sigma_px = settings.blur_sigma_px
    reach = 3 * math.ceil(sigma_px) - 1
    kernel = torch.exp(-(torch.arange(-reach, reach + 1.0).double() ** 2) / (2 * sigma_px**2))
    kernel = kernel / kernel.sum()
    kernel = (kernel[:, None] * kernel).expand(6, 1, -1, -1)

    def on_canvas(layer, at):
        left, top = (rim + place for place in at)
        room = size + 2 * rim - layer.shape[-1]
        return torch.nn.functional.pad(layer, (left, room - left, top, room - top))

    images = []
    for number, photograph in enumerate(photographs.double()):
        drawn = torch.zeros(6, size + 2 * rim, size + 2 * rim, dtype=torch.float64)
        for index in sorted(range(len(bodies)), key=lambda index: nearness[index]):
            if scenes[index] == number:
                body = on_canvas(bodies[index], body_at[index])
                shadow = on_canvas(shadows[index], shadow_at[index])
                hidden = torch.cat((body[3:].expand(4, -1, -1), shadow))
                drawn = drawn * (1 - hidden) + torch.cat((body, shadow))
        drawn = torch.nn.functional.conv2d(drawn[None], kernel, padding=reach, groups=6)
        drawn = drawn[0, :, rim : rim + size, rim : rim + size]
        lights = scene_lights([light], [scene()], photograph)
        ground = lights.received(srgb_to_linear(photograph)[None])[0]
        sky = lights.sky[0][:, None, None]
        kept = 1 - (1 - sky) * drawn[4] - sky * drawn[5]
        pixels = lights.shown((ground * kept * (1 - drawn[3]) + drawn[:3])[None])[0]
        # The scene's number is the seed of its noise.
        noise = noise_tiles([number])[0].double()[:, :size, :size]
        shown = linear_to_srgb(pixels) + settings.noise * drawn[3].detach() * noise
        reached = (drawn[3:] > 0).any(0)
        images.append(torch.where(reached, shown.clamp(0, 1), photograph))
    return torch.stack(images)


@pytest.mark.parametrize("light", [LIGHT, HAZY], ids=["clear", "hazy"])
@pytest.mark.parametrize("sigma_px", [0.6, 2.4])
def test_vehicles_that_hide_each_other_and_their_gradients_are_as_torch_has_them(sigma_px, light):
    settings = RenderSettings(blur_sigma_px=sigma_px, noise=0.01)
    photographs = noise_photograph(2) * 0.8 + 0.1
    # Three in one picture, the nearest not the last; one reaches over the corner of another.
    bodies = torch.cat([layer(15, seed) * 0.8 for seed in range(4)]).requires_grad_()
    shadows = torch.cat([layer(17, 4 + seed)[:, 2:] * 0.9 for seed in range(4)]).requires_grad_()
    body_at = [(17, 20), (-5, 38), (24, 26), (20, 14)]
    shadow_at = [(20, 16), (-2, 36), (22, 20), (14, 16)]
    given = (photographs, bodies, body_at, shadows, shadow_at, settings)
    where = ((0, 1, 0, 0), (1.0, 0.5, 3.0, 2.0))
    images, expected = compose(*given, *where, (0, 1), light), in_torch(*given, *where, light)
    torch.testing.assert_close(images, expected, atol=ROUNDING, rtol=0)
    weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    found, awaited = (
        torch.autograd.grad((each * weights).sum(), (bodies, shadows))
        for each in (images, expected)
    )
    for ours, theirs in zip(found, awaited, strict=True):
        # Of every one of the four.
        assert all(theirs.flatten(1).abs().amax(1) > 0.03)
        assert float((ours - theirs).abs().max()) < 1e-5 * float(theirs.abs().max())


def test_what_is_no_number_is_shown_as_none():
    settings = RenderSettings(blur_sigma_px=0.0, noise=0.0)
    body = layer(8, 0)
    body[:, :3, 3, 5] = torch.nan
    nothing = torch.zeros(1, 2, 1, 1)
    image = compose(noise_photograph(), body, [(10, 10)], nothing, [(10, 10)], settings)
    expected = torch.zeros_like(image, dtype=torch.bool)
    expected[:, :, 13, 15] = True
    assert torch.equal(image.isnan(), expected)
