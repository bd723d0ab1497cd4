"""Whole images: where shadows fall, how roofs lean, which way vehicles face, what batches keep."""

import dataclasses
import math

import pytest
import torch
from torch.nn import functional

from skyproof.errors import NotFiniteError, StoredFileError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.portrait import close_up
from skyproof.render.renderer import TorchRenderer, photographs
from skyproof.render.settings import RenderSettings
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Placement
from skyproof.scenes.sensor import Sensor
from tests.render.bodies import PlainGround, rounded_box, scene, vehicles

# Neither blur nor noise: what is drawn can be measured to the pixel.
SHARP = RenderSettings(blur_sigma_px=0.0, noise=0.0)
GSD = 0.125


def post(height_m=3.0, side_m=1.0):
    """A box with nearly sharp edges."""
    return dataclasses.replace(
        vehicles(), vertices=rounded_box(side_m, side_m, height_m, power=0.1)
    )


def step(low_m=1.0, high_m=3.0, rings=31):
    """A white box 6 m long whose rear half is higher than its front one."""
    vertices = rounded_box(6.0, 2.0, low_m, power=0.1, rings=rings)
    # Rings at equal distances, where those of a rounded box crowd at its ends.
    along_m = torch.linspace(3.0, -3.0, rings + 2)[1:-1].repeat_interleave(32)
    vertices[0, : len(along_m), 0] = along_m
    vertices[..., 2] *= torch.where(vertices[..., 0] < 0, high_m / low_m, 1.0)
    return dataclasses.replace(vehicles(), vertices=vertices, texture=torch.ones(1, 3, 512, 512))


def lit_from(place, azimuth_deg, elevation_deg):
    sun = dataclasses.replace(
        place.sun, azimuth_rad=math.radians(azimuth_deg), elevation_rad=math.radians(elevation_deg)
    )
    return dataclasses.replace(place, sun=sun)


def seen_from(place, azimuth_deg, tilt_deg):
    camera = dataclasses.replace(
        place.camera, azimuth_rad=math.radians(azimuth_deg), tilt_rad=math.radians(tilt_deg)
    )
    return dataclasses.replace(place, camera=camera)


def reach_m(pixels, azimuth_deg):
    """How far the pixels' centres reach from the image's middle towards an azimuth, metres."""
    rows, columns = pixels.nonzero(as_tuple=True)
    middle = pixels.shape[0] / 2
    east, north = (columns + 0.5 - middle) * GSD, (middle - rows - 0.5) * GSD
    azimuth = math.radians(azimuth_deg)
    return float((east * math.cos(azimuth) + north * math.sin(azimuth)).max())


@pytest.mark.parametrize("azimuth_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("elevation_deg", [35, 60])
def test_the_shadow_falls_away_from_the_sun_as_far_as_height_over_tangent(
    azimuth_deg, elevation_deg
):
    place = lit_from(scene((0, 0, 0), tilt_deg=0.0, size_px=112), azimuth_deg, elevation_deg)
    frames = TorchRenderer(PlainGround(0.4), SHARP)([place], post(), masks=True)
    shaded = (frames.image[0] < 0.39).all(0) & ~frames.masks[0]
    length_m = 3.0 / math.tan(math.radians(elevation_deg))
    assert reach_m(shaded, azimuth_deg + 180) == pytest.approx(length_m + 0.5, abs=1.5 * GSD)
    # Half the post is 0.5 m; nothing is dark beyond it on the sun's side or beside it.
    assert reach_m(shaded, azimuth_deg) < 0.5 + GSD
    assert reach_m(shaded, azimuth_deg + 90) < 0.5 + GSD


@pytest.mark.parametrize("azimuth_deg", [0, 90, 180, 270])
def test_a_higher_part_shades_the_lower_one_as_far_as_the_difference_over_tangent(azimuth_deg):
    # The sun stands behind the higher half, wherever that points.
    heading = (0.0, 0.0, float(azimuth_deg) - 180)
    place = lit_from(scene(heading, tilt_deg=0.0, size_px=96), azimuth_deg, 60)
    matt = dataclasses.replace(SHARP, gloss=0.0, light=Light(sky=(0.2, 0.2, 0.2)))
    shown = {}
    for shades in (True, False):
        settings = dataclasses.replace(matt, self_shadows=shades)
        image = TorchRenderer(PlainGround(0.4), settings)([place], step()).image[0, 0]
        away = math.radians(azimuth_deg + 180)
        # From the middle of the box to the end of its lower half.
        along_m = torch.arange(0.3, 2.4, 0.05)
        column = (48 + along_m * math.cos(away) / GSD).long()
        row = (48 - along_m * math.sin(away) / GSD).long()
        shown[shades] = srgb_to_linear(image[row, column])
    shaded_m = 0.3 + 0.05 * int((shown[True] < 0.5).sum())
    assert shaded_m == pytest.approx(2.0 / math.tan(math.radians(60)), abs=1.5 * GSD)
    # In the shadow half of the sky's light is left, beyond it nothing has changed.
    assert float(shown[True][0]) == pytest.approx(0.1, abs=0.03)
    assert torch.equal(shown[True][-20:], shown[False][-20:])
    assert float(shown[False].min()) > 0.9


@pytest.mark.parametrize("elevation_deg", [8, 20, 45, 80])
def test_a_body_without_hollows_shades_itself_nowhere(elevation_deg):
    place = lit_from(scene((-2.0, 1.0, 20.0), (3.0, -2.5, 110.0), tilt_deg=15.0), 70, elevation_deg)
    pictures = [
        TorchRenderer(PlainGround(0.4), dataclasses.replace(SHARP, self_shadows=shades))(
            [place], vehicles(2)
        ).image
        for shades in (True, False)
    ]
    assert torch.equal(*pictures)


def test_shaded_ground_keeps_four_fifths_of_the_sky_and_less_towards_the_vehicle():
    place = lit_from(scene((0, 0, 0), tilt_deg=0.0), 0, 45)
    renderer = TorchRenderer(PlainGround(None, light=Light(sky=(0.3, 0.2, 0.25))), SHARP)
    image = renderer([place], post(side_m=2.0)).image
    photograph = photographs(renderer.backgrounds, [place], torch.device("cpu"))
    # Between 1.5 and 3.5 m west of the middle, in the middle of the shadow.
    west = slice(48 - 28, 48 - 12)
    shaded, open_ground = (srgb_to_linear(each[0, :, 44:52, west]) for each in (image, photograph))
    kept = shaded / open_ground
    # By columns, from the far end of the shadow to the vehicle, in each channel alike.
    share = (kept / torch.tensor([0.3, 0.2, 0.25])[:, None, None]).mean(1)
    torch.testing.assert_close(share[1:], share[:1].expand(2, -1), atol=1e-3, rtol=0)
    assert (share[0].diff() < 0).all()
    assert float(share[0, 0]) == pytest.approx(0.8, abs=0.05)
    assert float(share[0, -1]) < 0.7


@pytest.mark.parametrize(("shade", "kept"), [(0.0, 0.2), (0.5, 0.36), (1.0, 1.0)])
def test_in_a_photographed_shadow_there_is_less_sun_to_lose_of_less_light(shade, kept):
    place = lit_from(scene((0, 0, 0), tilt_deg=0.0), 0, 45)
    place = dataclasses.replace(
        place, placements=(dataclasses.replace(place.placements[0], shade=shade),)
    )
    renderer = TorchRenderer(PlainGround(None, light=Light(sky=(0.25, 0.25, 0.25))), SHARP)
    image = renderer([place], post(side_m=2.0)).image
    photograph = photographs(renderer.backgrounds, [place], torch.device("cpu"))
    # The far end of the shadow: a fifth of a clear sky is missing there, of clouds nothing, and a
    # vehicle in the shade has clouds as far as it is in it: (0.25 - 0.025) / 0.625.
    far = (0, slice(None), slice(46, 50), slice(48 - 28, 48 - 26))
    found = (srgb_to_linear(image[far]) / srgb_to_linear(photograph[far])).mean()
    assert float(found) == pytest.approx(kept, abs=0.03)


@pytest.mark.parametrize("azimuth_deg", [0, 90, 180, 270])
def test_the_roof_leans_away_from_the_camera_by_height_times_tangent_of_tilt(azimuth_deg):
    place = seen_from(scene((0, 0, 0), size_px=96), azimuth_deg, 20)
    frames = TorchRenderer(PlainGround(0.4), SHARP)([place], post(), masks=True)
    lean_m = 3.0 * math.tan(math.radians(20))
    assert reach_m(frames.masks[0], azimuth_deg + 180) == pytest.approx(0.5 + lean_m, abs=1.5 * GSD)
    # The foot stays on the ground where it stands.
    assert reach_m(frames.masks[0], azimuth_deg) == pytest.approx(0.5, abs=1.5 * GSD)
    middle_px = frames.centres[0] - 48
    lean_px = lean_m / 2 / GSD
    away = math.radians(azimuth_deg + 180)
    assert middle_px.tolist() == pytest.approx(
        [lean_px * math.cos(away), -lean_px * math.sin(away)], abs=0.01
    )


@pytest.mark.parametrize(
    ("heading_deg", "towards"), [(0, (1, 0)), (90, (0, -1)), (180, (-1, 0)), (270, (0, 1))]
)
def test_heading_turns_the_nose_from_east_to_north(heading_deg, towards):
    # The first half of the map, from the nose to the middle, is red; the rest is blue.
    texture = torch.zeros(1, 3, 512, 512)
    texture[:, 0, :256], texture[:, 2, 256:] = 0.9, 0.9
    batch = dataclasses.replace(vehicles(), texture=texture)
    image = TorchRenderer(PlainGround(0.0), SHARP)(
        [scene((0, 0, heading_deg), tilt_deg=0.0)], batch
    ).image[0]
    ahead, behind = ([48 + sign * 10 * step for step in towards] for sign in (1, -1))
    nose, tail = image[:, ahead[1], ahead[0]], image[:, behind[1], behind[0]]
    assert nose[0] > 2 * nose[2]
    assert tail[2] > 2 * tail[0]


def test_black_is_no_hole():
    # On matt vehicles black sends 1.5 % of what white does, at every place alike.
    shown = []
    for value in (0.0, 1.0):
        batch = dataclasses.replace(vehicles(), texture=torch.full((1, 3, 512, 512), value))
        matt = dataclasses.replace(SHARP, gloss=0.0, light=Light(white=(0.5, 0.5, 0.5)))
        place = scene((0, 0, 20.0), tilt_deg=0.0)
        frames = TorchRenderer(PlainGround(0.2), matt)([place], batch, masks=True)
        inside = -functional.max_pool2d(-frames.masks[:1, None].float(), 3, 1, 1)[0, 0] > 0
        shown.append(srgb_to_linear(frames.image[0][:, inside]))
    torch.testing.assert_close(shown[0], 0.015 * shown[1], rtol=0.02, atol=1e-5)


def test_a_close_up_is_sharp():
    # White on grey ground: seen through 5 cm of roundness no step would be a third as high.
    batch = dataclasses.replace(vehicles(), texture=torch.ones(1, 3, 512, 512))
    picture = close_up(batch, gsd_m=0.016)[0].double().mean(0) / 255
    assert float(picture.diff(dim=1).abs().max()) > 0.25


def test_vehicles_stand_east_to_the_right_and_north_upwards():
    place = scene((2.0, 3.0, 0.0), tilt_deg=0.0)
    frames = TorchRenderer(PlainGround(0.4))([place], vehicles(), masks=True)
    assert frames.centres[0].tolist() == pytest.approx([48 + 16, 48 - 24], abs=1e-3)
    rows, columns = frames.masks[0].nonzero(as_tuple=True)
    assert float(columns.double().mean()) + 0.5 == pytest.approx(64, abs=0.3)
    assert float(rows.double().mean()) + 0.5 == pytest.approx(24, abs=0.3)


def test_labels_fit_what_is_drawn():
    frames = TorchRenderer(PlainGround(0.4))(
        [scene((0.4, -0.3, 30.0), tilt_deg=15.0)], vehicles(), masks=True
    )
    rows, columns = frames.masks[0].nonzero(as_tuple=True)
    drawn = [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]
    assert frames.boxes[0].tolist() == pytest.approx(drawn, abs=1.0)
    assert float(frames.visible_px) == pytest.approx(float(frames.masks.sum()), rel=0.03)
    assert float(frames.visible_fraction) == 1.0


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_of_two_vehicles_hides_the_farther_one(order):
    # The camera is in the east; the eastern vehicle leans over the western one.
    east, west = (1.0, 0.0, 90.0), (-0.3, 0.0, 90.0)
    place = seen_from(scene(*[east, west][::order], size_px=96), 0, 20)
    colours = (
        torch.tensor([[0.9, 0.05, 0.05], [0.05, 0.05, 0.9]])[::1]
        if order == 1
        else torch.tensor([[0.05, 0.05, 0.9], [0.9, 0.05, 0.05]])
    )
    batch = dataclasses.replace(
        vehicles(2), texture=colours[:, :, None, None].expand(2, 3, 512, 512).clone()
    )
    frames = TorchRenderer(PlainGround(0.4), dataclasses.replace(SHARP, gloss=0.0))(
        [place], batch, masks=True
    )
    outside = ~(frames.masks[0] & frames.masks[1])
    # A pixel at the border of one of them shows the other too.
    both = torch.nn.functional.max_pool2d(outside.float()[None], 3, 1, 1)[0] == 0
    assert both.sum() > 50
    red, _, blue = frames.image[0][:, both]
    assert (red > blue).float().mean() > 0.97


def test_a_vehicle_at_the_border_is_the_middle_of_a_larger_image():
    # Plain ground, so that the blur has the same ground beyond the border.
    settings = RenderSettings(noise=0.0)
    small, large = (scene((5.4, -5.8, 25.0), size_px=size) for size in (96, 160))
    renderer = TorchRenderer(PlainGround(0.4), settings)
    at_border, whole = (
        renderer([small], vehicles(), masks=True),
        renderer([large], vehicles(), masks=True),
    )
    torch.testing.assert_close(at_border.image, whole.image[..., 32:128, 32:128], atol=1e-5, rtol=0)
    assert torch.equal(at_border.masks, whole.masks[:, 32:128, 32:128])
    assert at_border.boxes[0, 2:].tolist() == [96.0, 96.0]
    assert at_border.boxes[0, :2].tolist() == pytest.approx(
        (whole.boxes[0, :2] - 32).tolist(), abs=1e-3
    )
    share = float(at_border.visible_px / whole.visible_px)
    assert 0.1 < share < 0.9
    assert float(at_border.visible_fraction) == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize("place", [(5.8, 0.0), (-5.8, 0.0), (0.0, 5.8), (0.0, -5.8), (0.0, 0.0)])
def test_what_is_visible_does_not_depend_on_whether_masks_are_asked_for(place):
    renderer = TorchRenderer(PlainGround(0.4))
    with_masks, without = (
        renderer([scene((*place, 25.0), size_px=96)], vehicles(), masks=masks)
        for masks in (True, False)
    )
    assert without.masks is None
    assert (without.visible_fraction < 0.9) == any(place)
    assert torch.equal(without.visible_fraction, with_masks.visible_fraction)
    assert torch.equal(without.visible_px, with_masks.visible_px)


def test_a_vehicle_outside_the_image_changes_nothing_and_is_not_visible():
    renderer = TorchRenderer(PlainGround(None))
    place = scene((40.0, 0.0, 0.0))
    frames = renderer([place], vehicles(), masks=True)
    assert torch.equal(
        frames.image, photographs(renderer.backgrounds, [place], torch.device("cpu"))
    )
    assert float(frames.visible_px) == float(frames.visible_fraction) == 0.0
    assert not frames.masks.any()


def test_a_background_that_is_missing_is_told_with_its_scene(tmp_path):
    backgrounds = write_procedural_backgrounds(tmp_path / "ground", {"test": 1}, 140, seed=0)
    with pytest.raises(StoredFileError, match=r"^The scene b lacks .*/ground has no tile 'tile'"):
        photographs(backgrounds, [scene(name="b")], torch.device("cpu"))


def test_scenes_without_vehicles_are_their_photographs():
    renderer = TorchRenderer(PlainGround(None))
    nobody = [scene(name="a"), scene(name="b")]
    frames = renderer(nobody, vehicles(0), masks=True)
    assert torch.equal(frames.image, photographs(renderer.backgrounds, nobody, torch.device("cpu")))
    assert frames.boxes.shape == (0, 4)
    assert frames.masks.shape == (0, 96, 96)
    mixed = renderer([nobody[0], scene((0, 0, 0))], vehicles(1))
    assert torch.equal(mixed.image[0], frames.image[0])
    assert mixed.scene_index.tolist() == [1]


def test_a_scene_is_the_same_alone_and_within_a_batch():
    batch, renderer = vehicles(4, seed=2), TorchRenderer(PlainGround(None))
    scenes = [
        scene((2.5, 1.0, 10.0), tilt_deg=3.0, seed=1, name="a"),
        scene((0.3, -0.2, 77.0), (-3.0, 2.5, 200.0), tilt_deg=17.0, seed=2, name="b"),
        scene((-4.0, 4.0, 300.0), tilt_deg=9.0, sun_elevation_deg=25.0, seed=3, name="c"),
    ]
    together = renderer(scenes, batch, masks=True)
    for index, rows in enumerate(([0], [1, 2], [3])):
        own = dataclasses.replace(
            batch,
            vertices=batch.vertices[rows],
            texture=batch.texture[rows],
            parts=batch.parts[rows],
            ids=tuple(batch.ids[row] for row in rows),
        )
        alone = renderer([scenes[index]], own, masks=True)
        assert torch.equal(together.image[index], alone.image[0])
        assert torch.equal(together.masks[rows], alone.masks)
        torch.testing.assert_close(together.boxes[rows], alone.boxes, atol=1e-4, rtol=0)


def test_each_image_has_the_blur_and_noise_of_its_own_ground():
    sensors = {"sharp": Sensor(0.55, 0.01), "soft": Sensor(2.4, 0.0), "bare": Sensor(0.0, 0.02)}
    grounds = PlainGround(None, sensors=sensors)
    batch = vehicles(3, seed=2)
    scenes = [
        dataclasses.replace(
            scene((0.3 * index, 1.0, 70.0 * index), seed=index, name=tile),
            background=BackgroundWindow(tile, 0.0, 0.0, 0.0),
        )
        for index, tile in enumerate(sensors)
    ]
    mixed = TorchRenderer(grounds)
    together = mixed(scenes, batch).image
    for index, (tile, sensor) in enumerate(sensors.items()):
        alone = mixed([scenes[index]], batch.row(index)).image[0]
        assert torch.equal(alone, together[index]), f"{tile} depends on the others of its batch"
        # A setting stands for the ground's own, whatever that is; edges of vehicles are rounder
        # than the ground's are sharp, by 5 cm.
        rounded_px = round(math.hypot(sensor.blur_sigma_px, 0.05 / scenes[index].camera.gsd_m), 3)
        asked = RenderSettings(blur_sigma_px=rounded_px, noise=sensor.noise)
        told = TorchRenderer(PlainGround(None), asked)(scenes, batch).image[index]
        assert torch.equal(told, together[index])
    record = mixed.record(scenes)
    assert (record["blur_sigma_px"], record["noise"]) == ([0.4, 0.68, 2.433], [0.0, 0.01, 0.02])
    assert mixed.record(scenes[:1])["blur_sigma_px"] == 0.68
    told = TorchRenderer(grounds, RenderSettings(blur_sigma_px=1.0)).record(scenes)
    assert (told["blur_sigma_px"], told["noise"]) == (1.0, [0.0, 0.01, 0.02])


def test_the_seed_decides_the_noise_and_nothing_else_does():
    renderer = TorchRenderer(PlainGround(None))
    first, other = scene((0, 0, 20.0), seed=5), scene((0, 0, 20.0), seed=6)
    torch.manual_seed(1)
    one = renderer([first], vehicles()).image
    torch.manual_seed(2)
    assert torch.equal(one, renderer([first], vehicles()).image)
    different = (one - renderer([other], vehicles()).image).abs()
    assert different.max() > 1e-3
    quiet = RenderSettings(noise=0.0)
    still = TorchRenderer(PlainGround(None), quiet)
    assert torch.equal(still([first], vehicles()).image, still([other], vehicles()).image)


def test_another_vehicle_far_away_leaves_pixels_and_their_noise_alone():
    renderer, batch = TorchRenderer(PlainGround(None)), vehicles(2)
    first = dataclasses.replace(
        batch,
        vertices=batch.vertices[:1],
        texture=batch.texture[:1],
        parts=batch.parts[:1],
        ids=batch.ids[:1],
    )
    alone = renderer([scene((4.0, -3.5, 20.0), size_px=128)], first).image
    both = renderer([scene((4.0, -3.5, 20.0), (-4.0, 3.5, 70.0), size_px=128)], batch).image
    torch.testing.assert_close(both[..., 64:, 64:], alone[..., 64:, 64:], atol=1e-6, rtol=0)
    assert not torch.equal(both[..., :64, :64], alone[..., :64, :64])


def test_the_number_of_vehicles_must_fit_the_scenes():
    with pytest.raises(ValueError, match=r"\b1\b.*\b2\b|\b2\b.*\b1\b"):
        TorchRenderer(PlainGround(0.4))([scene((0, 0, 0))], vehicles(2))


def test_one_shared_map_equals_the_same_map_for_each_vehicle():
    renderer, batch = TorchRenderer(PlainGround(0.4)), vehicles(2, seed=1)
    place = [scene((2.0, 0, 0), (-3.0, 1.0, 90.0))]
    shared = dataclasses.replace(batch, texture=batch.texture[:1])
    each = dataclasses.replace(batch, texture=batch.texture[:1].expand(2, -1, -1, -1).clone())
    assert torch.equal(renderer(place, shared).image, renderer(place, each).image)


def test_a_placement_is_read_in_metres_from_the_middle_of_the_image():
    place = scene()
    place = dataclasses.replace(place, placements=(Placement("box-0000", -3.0, 0.0, 0.0),))
    frames = TorchRenderer(PlainGround(0.4))([place], vehicles())
    assert frames.centres[0, 0] < 48 - 3.0 / GSD + 3


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_vertices_that_are_no_numbers_are_refused_in_a_sentence(value):
    batch = vehicles(3)
    batch.vertices[1, 5, 2] = value
    places = scene((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (-5.0, 0.0, 0.0))
    with pytest.raises(NotFiniteError, match=r"finite numbers, but 1 of 3 have others"):
        TorchRenderer(PlainGround(0.4))([places], batch)
