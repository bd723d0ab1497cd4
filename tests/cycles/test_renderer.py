"""Whole images: the photograph where nothing is, the same labels, the same bytes every time."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from skyproof.cycles.blender import Blender
from skyproof.cycles.jobs import crop_windows
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.render.dataset import render_dataset
from skyproof.render.frames import Renderer
from skyproof.render.placed import place
from skyproof.render.renderer import TorchRenderer, photographs
from skyproof.render.settings import RenderSettings
from skyproof.render.weather import finish_images
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Placement
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.weather import Weather
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import Overlay
from tests.render.bodies import PAPER_SENSOR, PlainGround, scene, vehicles

COARSE = CyclesSettings(samples=1)
LABELS = ("scene_index", "boxes", "centres", "visible_px", "visible_fraction", "masks")


class Shadows(Workers):
    """Stands for Blender: every crop is ground in half its light, a grey body in its middle."""

    def __init__(self):
        self.blender, self.asked = Blender(Path("nowhere"), True, "4.5.0"), []

    def run(self, jobs):
        self.asked += jobs
        results = []
        for job in jobs:
            _, _, width, height = job.window_px
            result = np.full((height, width, 7), 0.5, dtype=np.float32)
            result[..., :4] = 0
            result[height // 3 : -height // 3, width // 3 : -width // 3, :4] = (0.2, 0.2, 0.2, 1.0)
            results.append(result)
        return results


def some_scenes():
    return [
        scene((0.5, -0.3, 20), seed=1, name="one"),
        scene(seed=2, name="empty"),
        # Near enough to shade each other, and one across the border.
        scene(
            (-2, 1, 100),
            (0.5, 1.2, 80),
            (5.6, -4, 10),
            seed=3,
            name="three",
            sun_elevation_deg=30,
            tilt_deg=18,
        ),
        scene((30, 0, 0), seed=4, name="far away"),
    ]


def batch_for(scenes):
    return vehicles(sum(len(each.placements) for each in scenes))


def clothed(batch):
    """A camouflage over half of every vehicle."""
    mask = torch.zeros(len(batch), 512, 512, dtype=torch.bool)
    mask[:, 100:350] = True
    return dataclasses.replace(batch, overlay=Overlay(torch.full((3, 512, 512), 0.9), mask))


def near_crops(scenes, batch, renderer):
    """Per image the pixels within a crop or the reach of the blur."""
    placed, radius = place(scenes, batch), PAPER_SENSOR.blur_radius_px
    margin = round(renderer.settings.margin_m / placed.gsd_m)
    allowed = torch.zeros(len(scenes), 96, 96, dtype=torch.bool)
    for index, (left, top, right, bottom) in zip(
        placed.scene.tolist(),
        crop_windows(placed, margin, [radius] * len(scenes)).tolist(),
        strict=True,
    ):
        if right > left and bottom > top:
            rows, columns = (
                slice(max(top - radius, 0), bottom + radius),
                slice(max(left - radius, 0), right + radius),
            )
            allowed[index, rows, columns] = True
    return allowed


def test_it_is_a_renderer_that_says_what_its_images_depend_on():
    renderer = CyclesRenderer(PlainGround(), Shadows(), CyclesSettings(samples=7, finish="matt"))
    other = TorchRenderer(PlainGround())
    assert isinstance(renderer, Renderer)
    assert isinstance(other, Renderer)
    assert (renderer.name, renderer.differentiable) == ("cycles", False)
    assert (other.name, other.differentiable) == ("torch", True)
    record = renderer.record([scene()])
    assert (record["samples"], record["finish"], record["blender"]) == (7, "matt", "4.5.0")
    # Of what the sensor does, all that its images depend on, and no light of the other renderer's
    # own.
    shared = ("blur_sigma_px", "noise")
    assert {name: record[name] for name in shared} == {
        name: other.record([scene()])[name] for name in shared
    }
    assert "gloss" not in record
    assert "light" not in record
    dim = CyclesRenderer(
        PlainGround(), Shadows(), shared=RenderSettings(light=Light(white=(0.5, 0.5, 0.5)))
    )
    assert dim.record([scene()])["light"]["white"] == (0.5, 0.5, 0.5)
    assert json.loads(json.dumps(record)) == record
    assert json.loads(json.dumps(other.record([scene()]))) == other.record([scene()])


def test_each_image_has_the_blur_of_its_own_ground():
    # The dark shadow reaches over the whole crop, so that every vehicle's blur can be seen.
    sensors = {"sharp": Sensor(0.6, 0.01), "soft": Sensor(2.4, 0.0)}
    renderer = CyclesRenderer(PlainGround(None, sensors=sensors), Shadows())
    batch = vehicles(2)
    scenes = [
        dataclasses.replace(
            scene((5.5, 0.0, 10.0), name=tile), background=BackgroundWindow(tile, 0.0, 0.0, 0.0)
        )
        for tile in sensors
    ]
    together = renderer(scenes, batch).image
    # The ground's blur, and what the roundness of edges adds to it.
    rounded_px = (0.721, 2.433)
    for index, sensor in enumerate(sensors.values()):
        asked = RenderSettings(blur_sigma_px=rounded_px[index], noise=sensor.noise)
        told = CyclesRenderer(PlainGround(None), Shadows(), shared=asked)
        assert torch.equal(renderer([scenes[index]], batch.row(index)).image[0], together[index])
        assert torch.equal(told(scenes, batch).image[index], together[index])
    assert not torch.equal(together[0], together[1])
    assert renderer.record(scenes)["blur_sigma_px"] == [*rounded_px]


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ConfigurationError, match="samples expects a whole number from 1"):
        CyclesSettings(samples=0)


def test_crops_lie_where_their_vehicles_are():
    scenes = some_scenes()
    frames = CyclesRenderer(PlainGround(0.4), Shadows())(scenes, batch_for(scenes), masks=True)
    dark = frames.image[0].mean(0) < 0.37
    rows, columns = dark.nonzero(as_tuple=True)
    (left, top, right, bottom) = frames.boxes[0].tolist()
    # 1 m around body and shadow, less what fades out.
    assert int(columns.min()) < left
    assert int(columns.max()) > right
    assert int(rows.min()) < top
    assert int(rows.max()) > bottom
    assert dark.float().mean() < 0.7


@pytest.mark.parametrize(
    "weather",
    [
        Weather("haze", haze=0.3),
        Weather("exposure", exposure_stops=-0.7),
        Weather("noise", noise=0.03),
        Weather("jpeg", jpeg_quality=30),
    ],
    ids=lambda weather: weather.condition,
)
def test_weather_lies_over_the_finished_picture(weather):
    clear = some_scenes()
    renderer, batch = CyclesRenderer(PlainGround(None), Shadows()), batch_for(clear)
    scenes = [dataclasses.replace(each, weather=weather) for each in clear]
    expected = finish_images(renderer(clear, batch).image, scenes)
    assert torch.equal(renderer(scenes, batch).image, expected)
    assert not torch.equal(expected, renderer(clear, batch).image)


def test_wet_ground_is_dark_in_the_picture_and_in_the_light_it_sends_up():
    dry = some_scenes()[:1]
    wet = [dataclasses.replace(each, weather=Weather("rain", wetness=1.0)) for each in dry]
    ground = {}
    for name, scenes in (("dry", dry), ("wet", wet)):
        stand_in = Shadows()
        image = CyclesRenderer(PlainGround(0.4), stand_in)(scenes, batch_for(scenes)).image
        ground[name] = (float(image[0, 0, 0, 0]), float(stand_in.asked[0].arrays["ground"].mean()))
    assert ground["wet"][0] < ground["dry"][0]
    assert ground["wet"][1] < 0.8 * ground["dry"][1]


def test_one_crop_for_every_vehicle_that_may_be_seen_with_those_that_reach_into_it():
    scenes, stand_in = some_scenes(), Shadows()
    CyclesRenderer(PlainGround(0.4), stand_in)(scenes, batch_for(scenes))
    names = [job.name for job in stand_in.asked]
    assert names == [
        "vehicle 1 of one",
        "vehicle 1 of three",
        "vehicle 2 of three",
        "vehicle 3 of three",
    ]
    placed = place(scenes, batch_for(scenes)).vertices
    shown = [job.arrays["vertices"] for job in stand_in.asked]
    assert len(shown[0]) == 1
    for row, neighbours in ((0, [0]), (1, [1, 2]), (2, [1, 2]), (3, [3])):
        for neighbour in neighbours:
            assert any((vertices == placed[neighbour].numpy()).all() for vertices in shown[row]), (
                row,
                neighbour,
            )


def test_pairs_share_their_noise():
    scenes, stand_in = some_scenes(), Shadows()
    renderer, batch = CyclesRenderer(PlainGround(0.4), stand_in), batch_for(scenes)
    renderer(scenes, batch)
    renderer(scenes, clothed(batch))
    seeds = [job.numbers["seed"] for job in stand_in.asked]
    assert seeds[:4] == seeds[4:]
    assert len(set(seeds)) == 4


@pytest.mark.blender
def test_scenes_without_vehicles_are_their_photographs(workers):
    renderer, scenes = CyclesRenderer(PlainGround(None), workers, COARSE), some_scenes()
    photograph = photographs(renderer.backgrounds, scenes, torch.device("cpu"))
    frames = renderer(scenes, batch_for(scenes), masks=True)
    for index in (1, 3):
        assert torch.equal(frames.image[index], photograph[index])
    empty = renderer([scenes[1]], vehicles(0), masks=True)
    assert torch.equal(empty.image, photograph[1:2])
    assert empty.masks.shape == (0, 96, 96)


@pytest.mark.blender
def test_labels_are_the_other_renderers(workers):
    scenes = some_scenes()
    frames = CyclesRenderer(PlainGround(0.4), workers, COARSE)(
        scenes, batch_for(scenes), masks=True
    )
    other = TorchRenderer(PlainGround(0.4))(scenes, batch_for(scenes), masks=True)
    for name in LABELS:
        assert torch.equal(getattr(frames, name), getattr(other, name)), name
    # And what is drawn is there: bodies hide the ground's grey where the masks say.
    without = CyclesRenderer(PlainGround(0.4), workers, COARSE)(scenes[1:2], vehicles(0)).image[0]
    changed = (frames.image[0] - without).abs().amax(0) > 0.03
    assert changed[frames.masks[0]].float().mean() > 0.9


@pytest.mark.blender
def test_pairs_differ_around_the_vehicles_alone(workers):
    scenes = some_scenes()
    renderer, batch = CyclesRenderer(PlainGround(None), workers, COARSE), batch_for(scenes)
    before, after = (
        renderer(scenes, batch, masks=True),
        renderer(scenes, clothed(batch), masks=True),
    )
    differs = (before.image != after.image).any(1)
    assert not (differs & ~near_crops(scenes, batch, renderer)).any()
    assert differs[0][before.masks[0]].float().mean() > 0.5
    for name in LABELS:
        assert torch.equal(getattr(before, name), getattr(after, name)), name


@pytest.mark.blender
def test_the_same_bytes_whatever_the_number_and_order(blender, workers):
    scenes = some_scenes()
    batch, ground = batch_for(scenes), PlainGround(None)
    one = CyclesRenderer(ground, workers, COARSE)(scenes, batch).image
    turned, rows = scenes[::-1], [4, 1, 2, 3, 0]
    shuffled = dataclasses.replace(
        batch, vertices=batch.vertices[rows], texture=batch.texture[rows], parts=batch.parts[rows]
    )
    # Processes of their own: those of the first would read what they have rendered.
    with Workers(blender, 2) as two:
        assert torch.equal(CyclesRenderer(ground, two, COARSE)(turned, shuffled).image.flip(0), one)


@pytest.mark.blender
def test_a_dataset_says_who_rendered_it(workers, tmp_path):
    fleet = sample_fleet(FleetSettings(count=1), generator=torch.Generator().manual_seed(0))
    place = scene((0, 0, 30), name="only")
    worn = tuple(
        Placement(fleet.ids[0], each.x_m, each.y_m, each.heading_rad) for each in place.placements
    )
    scenes = [dataclasses.replace(place, placements=worn)]
    for name, renderer in (
        ("cycles", CyclesRenderer(PlainGround(), workers, COARSE)),
        ("torch", TorchRenderer(PlainGround())),
    ):
        render_dataset(tmp_path / name, scenes, fleet, renderer)
        dataset = Dataset.open(tmp_path / name)
        assert (dataset.renderer, dataset.rendering) == (name, renderer.record(scenes))


def test_what_stands_beneath_a_crown_is_hidden_as_by_the_other_renderer():
    crown = torch.zeros(96, 96)
    crown[:, :48] = 1.0
    place = scene((0.0, 0.0, 0.0), tilt_deg=0.0)
    (stands,) = place.placements
    place = dataclasses.replace(place, placements=(dataclasses.replace(stands, covered=0.4),))
    ground = PlainGround(value=None, cover=crown)
    frames = CyclesRenderer(ground, Shadows(), COARSE)([place], vehicles(), masks=True)
    photograph = ground.window(place.background, 96)
    assert torch.equal(frames.image[0, :, :, :48], photograph[:, :, :48])
    assert not torch.equal(frames.image[0, :, :, 48:], photograph[:, :, 48:])
    other = TorchRenderer(ground)([place], vehicles(), masks=True)
    assert torch.equal(frames.visible_fraction, other.visible_fraction)
    assert torch.equal(frames.masks, other.masks)
