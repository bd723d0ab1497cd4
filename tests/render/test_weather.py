"""Weather in the picture: every formula by hand, clear pictures untouched, gradients that flow."""

import dataclasses
import io
import math

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.renderer import TorchRenderer, photographs
from skyproof.render.settings import RenderSettings
from skyproof.render.weather import AIRLIGHT, finish_images, jpeg, wet, wet_grounds
from skyproof.scenes.weather import CONDITIONS, Weather
from tests.render.bodies import PlainGround, rounded_box, scene, vehicles

SHARP = RenderSettings(blur_sigma_px=0.0, noise=0.0)
GSD = 0.125


def under(weather, *places, **changes):
    return dataclasses.replace(scene(*(places or ((0.0, 0.0, 20.0),)), **changes), weather=weather)


def to_linear(srgb):
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


def to_srgb(linear):
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def finish(image, weather, seed=0):
    return finish_images(image[None], [dataclasses.replace(scene(seed=seed), weather=weather)])[0]


def one_pixel(*srgb):
    return torch.tensor(srgb, dtype=torch.float64)[:, None, None]


def test_haze_mixes_airlight_into_linear_light():
    hazy = finish(one_pixel(0.2, 0.5, 0.9), Weather(haze=0.3)).flatten().tolist()
    expected = [
        to_srgb(0.7 * to_linear(v) + 0.3 * a)
        for v, a in zip((0.2, 0.5, 0.9), AIRLIGHT, strict=True)
    ]
    assert hazy == pytest.approx(expected, abs=1e-9)


def test_one_stop_doubles_the_light_and_clips_it():
    brighter = finish(one_pixel(0.2, 0.5, 0.9), Weather(exposure_stops=1.0)).flatten().tolist()
    assert brighter == pytest.approx(
        [to_srgb(2 * to_linear(0.2)), to_srgb(2 * to_linear(0.5)), 1.0], abs=1e-9
    )
    darker = finish(one_pixel(0.2, 0.5, 0.9), Weather(exposure_stops=-1.0)).flatten().tolist()
    assert darker == pytest.approx([to_srgb(to_linear(v) / 2) for v in (0.2, 0.5, 0.9)], abs=1e-9)


def test_haze_comes_before_exposure():
    both = (
        finish(one_pixel(0.3, 0.3, 0.3), Weather(haze=0.4, exposure_stops=-0.5)).flatten().tolist()
    )
    expected = [to_srgb((0.6 * to_linear(0.3) + 0.4 * a) * 2**-0.5) for a in AIRLIGHT]
    assert both == pytest.approx(expected, abs=1e-9)


def test_wet_ground_by_hand():
    # a / (a + 1.33^2 (1 - a)) for 0.1: 0.1 / (0.1 + 1.7689 * 0.9) = 0.0591; for 0.4: 0.4 / 1.46134
    # = 0.2737.
    dry = torch.tensor([0.0, 0.1, 0.4, 1.0], dtype=torch.float64)
    assert wet(dry, 1.0).tolist() == pytest.approx([0.0, 0.05910, 0.27372, 1.0], abs=1e-5)
    assert wet(dry, 0.5).tolist() == pytest.approx([0.0, 0.07955, 0.33686, 1.0], abs=1e-5)
    # Brown soil becomes darker and more saturated.
    soil = torch.tensor([0.30, 0.20, 0.12], dtype=torch.float64)
    damp = wet(soil, 0.8)
    assert (damp < soil).all()
    assert float(damp.max() / damp.min()) > float(soil.max() / soil.min())


def test_rain_wets_its_own_photographs_only():
    photographs = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    scenes = [under(Weather()), under(Weather("rain", wetness=1.0))]
    drawn = wet_grounds(photographs.clone(), scenes)
    assert torch.equal(drawn[0], photographs[0])
    expected = wet(srgb_to_linear(photographs[1].double()), 1.0)
    torch.testing.assert_close(srgb_to_linear(drawn[1].double()), expected, atol=1e-5, rtol=0)


def test_rain_darkens_the_picture_but_not_the_vehicle():
    renderer = TorchRenderer(PlainGround(None), SHARP)
    scenes = [under(Weather()), under(Weather("rain", wetness=1.0))]
    dry, rainy = (renderer([each], vehicles(), masks=True) for each in scenes)
    light = [srgb_to_linear(frames.image).mean() for frames in (dry, rainy)]
    assert 0.6 < float(light[1] / light[0]) < 0.9
    # Away from its rim the vehicle hides the ground.
    inner = torch.nn.functional.avg_pool2d(dry.masks[:1].float(), 5, 1, 2)[0] == 1
    assert inner.sum() > 100
    torch.testing.assert_close(rainy.image[0][:, inner], dry.image[0][:, inner], atol=1e-6, rtol=0)


@pytest.mark.parametrize("quality", [20, 60])
def test_jpeg_is_pillows_own_round_trip(quality):
    image = torch.rand(3, 37, 50, generator=torch.Generator().manual_seed(1))
    pixels = Image.fromarray((image * 255).round().byte().permute(1, 2, 0).numpy())
    buffer = io.BytesIO()
    pixels.save(buffer, format="JPEG", quality=quality)
    expected = np.asarray(Image.open(io.BytesIO(buffer.getvalue())))
    drawn = finish(image, Weather("jpeg", jpeg_quality=quality))
    assert np.array_equal((drawn * 255).round().byte().permute(1, 2, 0).numpy(), expected)


def test_jpeg_passes_gradients_straight_through():
    image = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(1)).requires_grad_()
    weights = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(2))
    (jpeg(image, 30) * weights).sum().backward()
    assert torch.equal(image.grad, weights)


def test_noise_lies_on_the_whole_picture_with_its_strength_and_seed():
    plain = torch.full((3, 96, 96), 0.5)
    noisy = finish(plain, Weather("noise", noise=0.03), seed=4)
    assert float(noisy.std()) == pytest.approx(0.03, rel=0.03)
    assert float(noisy.mean()) == pytest.approx(0.5, abs=1e-3)
    assert torch.equal(noisy, finish(plain, Weather("noise", noise=0.03), seed=4))
    assert not torch.equal(noisy, finish(plain, Weather("noise", noise=0.03), seed=5))


def test_the_pictures_noise_is_not_that_of_its_vehicles():
    # Both follow the scene's seed; were they one, vehicles would show it twice as strong. 64 px is
    # the tile of theirs.
    still, noisy = RenderSettings(noise=0.0), RenderSettings(noise=0.02)
    place, weather = scene((0, 0, 0.0), seed=3, size_px=64), Weather("noise", noise=0.02)
    quiet = TorchRenderer(PlainGround(0.4), still)([place], vehicles(), masks=True)
    inside = quiet.masks[0]
    own = (TorchRenderer(PlainGround(0.4), noisy)([place], vehicles()).image - quiet.image)[0][
        :, inside
    ]
    whole = (finish(quiet.image[0], weather, seed=3) - quiet.image[0])[:, inside]
    assert abs(float(torch.corrcoef(torch.stack((own.flatten(), whole.flatten())))[0, 1])) < 0.1


@pytest.mark.parametrize("condition", CONDITIONS)
def test_a_clear_scene_keeps_its_bits_whatever_its_neighbours_in_the_batch(condition):
    renderer, batch = TorchRenderer(PlainGround(None)), vehicles(2, seed=2)
    clear, other = scene((0.3, -0.2, 77.0)), under(CONDITIONS[condition](0.9), (1.0, 0.5, 30.0))
    # A clear neighbour in the same place: windows are as large.
    usual = renderer([clear, dataclasses.replace(other, weather=Weather())], batch).image
    mixed = renderer([clear, other], batch).image
    assert torch.equal(usual[0], mixed[0])
    assert torch.equal(usual[1], mixed[1]) == (condition == "clear")


def test_pictures_without_vehicles_have_weather_too():
    renderer = TorchRenderer(PlainGround(None))
    place = dataclasses.replace(scene(), weather=Weather(haze=0.4, wetness=1.0))
    light = srgb_to_linear(renderer([place], vehicles(0)).image[0])
    photograph = srgb_to_linear(photographs(renderer.backgrounds, [place], torch.device("cpu"))[0])
    expected = 0.6 * wet(photograph, 1.0) + 0.4 * torch.tensor(AIRLIGHT)[:, None, None]
    torch.testing.assert_close(light, expected, atol=1e-5, rtol=0)


def post(height_m):
    return dataclasses.replace(vehicles(), vertices=rounded_box(1.0, 1.0, height_m, power=0.1))


def shaded_length_m(frames, ground):
    """How far the shaded ground reaches from the image's middle, metres."""
    rows, columns = ((frames.image[0] < ground - 0.005).all(0) & ~frames.masks[0]).nonzero(
        as_tuple=True
    )
    middle = frames.image.shape[-1] / 2
    return float(torch.hypot((columns + 0.5 - middle), (rows + 0.5 - middle)).max()) * GSD


@pytest.mark.parametrize("elevation_deg", [8, 14, 20])
def test_a_low_suns_shadow_is_as_long_as_height_over_tangent(elevation_deg):
    # 10.7 m at 8 degrees: it must not be cut by its window; the image is large enough for it.
    place = scene((0, 0, 0), tilt_deg=0.0, size_px=208)
    sun = dataclasses.replace(
        place.sun, azimuth_rad=math.radians(90), elevation_rad=math.radians(elevation_deg)
    )
    place = dataclasses.replace(place, sun=sun, weather=Weather("low_sun", overcast=0.3))
    frames = TorchRenderer(PlainGround(0.4), SHARP)([place], post(1.5), masks=True)
    length_m = 1.5 / math.tan(math.radians(elevation_deg)) + 0.5
    assert shaded_length_m(frames, 0.4) == pytest.approx(length_m, abs=2 * GSD)


@pytest.mark.parametrize("overcast", [0.0, 0.4, 1.0])
def test_clouds_take_the_shadow_away_and_leave_the_darkness_beside_the_vehicle(overcast):
    place = scene((0, 0, 0), tilt_deg=0.0)
    sun = dataclasses.replace(place.sun, azimuth_rad=0.0, elevation_rad=math.radians(45))
    place = dataclasses.replace(place, sun=sun, weather=Weather("overcast", overcast=overcast))
    image = TorchRenderer(PlainGround(0.4), SHARP)([place], post(3.0)).image
    light = srgb_to_linear(image[0, 1, 46:50]).mean(0) / to_linear(0.4)
    # West, in the middle of the cast shadow: of green light a quarter of the sky's and the clouds'
    # stay, less what the post hides. East there is no shadow but the contact's.
    west, east = float(light[48 - 20]), float(light[48 + 20])
    open_sky = 0.253 + 0.747 * overcast
    assert 0.7 * open_sky < west < open_sky
    assert east == pytest.approx(1.0, abs=0.03 + 0.2 * overcast)
    close = float(light[48 + 6])
    # A slim post hides little of the sky, and of a clear one the bright side gives it back.
    assert abs(close - east) < 0.01 if not overcast else east - close > 0.015 * overcast


def test_without_sun_only_the_sky_lights_a_vehicle():
    # A level white matt roof on open ground sends 1 under every sky; its sun side is no brighter
    # than the other.
    settings = dataclasses.replace(SHARP, gloss=0.0)
    batch = dataclasses.replace(vehicles(), texture=torch.full((1, 3, 512, 512), 0.6))
    images = [
        TorchRenderer(PlainGround(0.1), settings)(
            [under(Weather(overcast=o), (0.0, 0.0, 0.0), tilt_deg=0.0)], batch
        )
        for o in (0.0, 1.0)
    ]
    clear, cloudy = (frames.image[0, 0] for frames in images)
    assert float(clear[48, 48]) == pytest.approx(float(cloudy[48, 48]), abs=0.01)
    turned = cloudy.flip(0, 1)
    assert (
        float((cloudy - turned).abs().max()) < 0.02 < float((clear - clear.flip(0, 1)).abs().max())
    )


@pytest.mark.parametrize(
    "weather", [Weather(haze=0.3), Weather(exposure_stops=-0.8), Weather(haze=0.2, noise=0.01)]
)
def test_gradients_of_what_finishes_a_picture(weather):
    image = (
        (0.2 + 0.5 * torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(0)))
        .double()
        .requires_grad_()
    )
    assert torch.autograd.gradcheck(lambda x: finish(x, weather), image)


@pytest.mark.parametrize("stops", [-1.0, 1.0])
def test_gradients_stay_finite_in_black_and_white(stops):
    image = torch.tensor([0.0, 1.0, 0.999])[:, None, None].requires_grad_()
    finish(image, Weather(haze=0.2, exposure_stops=stops, noise=0.02)).sum().backward()
    assert image.grad.isfinite().all()


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_lets_gradients_reach_texture_and_vertices(condition):
    batch = vehicles(seed=1)
    texture, vertices = (
        batch.texture.clone().requires_grad_(),
        batch.vertices.clone().requires_grad_(),
    )
    batch = dataclasses.replace(batch, texture=texture, vertices=vertices)
    image = TorchRenderer(PlainGround(0.4))([under(CONDITIONS[condition](0.2))], batch).image
    image.square().sum().backward()
    for gradient in (texture.grad, vertices.grad):
        assert gradient.isfinite().all()
        assert gradient.abs().sum() > 0
