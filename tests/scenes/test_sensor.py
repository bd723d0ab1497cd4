"""The sensor of a background set decides how vehicles are drawn on it."""

import dataclasses
import json

import pytest
import torch
from tests.render.bodies import scene

from skyproof.attacks.world import World
from skyproof.cycles.renderer import open_renderer
from skyproof.cycles.settings import Rendering
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.ground.procedural import GroundSensor, write_procedural_backgrounds
from skyproof.imagery.photographs import measure_sensor
from skyproof.scenes.background_index import BackgroundTile, change_sensors, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import BackgroundWindow
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import FleetSettings, sample_fleet


def window(tile):
    return BackgroundWindow(tile, 100.0, 100.0, 0.0)


# The folder's 0.8 px, and the 5 cm by which edges of vehicles are rounder than the ground's.
ROUNDED_PX = 0.894


@pytest.fixture
def folder(tmp_path):
    tiles = []
    for split in ("train", "attack"):
        tile = BackgroundTile(
            id=split, file=f"{split}.png", split=split, width_px=200, height_px=200, source="grey"
        )
        save_tile(tmp_path, tile, torch.full((3, 200, 200), 100, dtype=torch.uint8))
        tiles.append(tile)
    write_index(tmp_path, 0.125, tiles, Sensor(blur_sigma_px=0.8, noise=0.02))
    return tmp_path


def test_is_stored_with_the_set(folder):
    assert BackgroundSet.open(folder).sensor == Sensor(0.8, 0.02)


def test_sets_of_before_are_read(folder):
    index = json.loads((folder / "index.json").read_text())
    for tile in index["tiles"]:
        del tile["sensor"]
    (folder / "index.json").write_text(json.dumps(index))
    assert BackgroundSet.open(folder).sensor_of(window("train")) == Sensor(0.8, 0.02)
    # The oldest name no sensor at all: vehicles had the paper's blur on them.
    del index["sensor"]
    (folder / "index.json").write_text(json.dumps(index))
    assert BackgroundSet.open(folder).sensor_of(window("train")) == Sensor(2.4, 0.006)


def test_a_tile_may_have_its_own(folder):
    index = json.loads((folder / "index.json").read_text())
    index["tiles"][1]["sensor"] = {"blur_sigma_px": 0.5, "noise": 0.01}
    (folder / "index.json").write_text(json.dumps(index))
    backgrounds = BackgroundSet.open(folder)
    assert backgrounds.sensor_of(window("train")) == Sensor(0.8, 0.02)
    assert backgrounds.sensor_of(window("attack")) == Sensor(0.5, 0.01)
    with pytest.raises(StoredFileError, match="has no tile 'other'"):
        backgrounds.sensor_of(window("other"))
    # What is changed is changed everywhere, and nothing else.
    change_sensors(folder, lambda its: dataclasses.replace(its, blur_sigma_px=2.4))
    backgrounds = BackgroundSet.open(folder)
    assert backgrounds.sensor_of(window("train")) == Sensor(2.4, 0.02)
    assert backgrounds.sensor_of(window("attack")) == Sensor(2.4, 0.01)


def test_drawn_ground_names_the_blur_and_noise_it_was_drawn_with(tmp_path, monkeypatch):
    backgrounds = write_procedural_backgrounds(tmp_path / "ground", {"train": 3}, 200, seed=1)
    own = [tile.sensor for tile in backgrounds.tiles("train")]
    assert len(set(own)) == 3
    for sensor in own:
        assert 0.5 <= sensor.blur_sigma_px <= 0.85
        assert 0.004 <= sensor.noise <= 0.012
    # The very same ground through two cameras.
    drawn = GroundSensor.draw
    measured = []
    for blur_px in (0.5, 0.85):

        def camera(rng, blur_px=blur_px):
            return dataclasses.replace(drawn(rng), blur_px=blur_px, noise=0.004)

        monkeypatch.setattr(GroundSensor, "draw", camera)
        backgrounds = write_procedural_backgrounds(
            tmp_path / f"{blur_px}", {"train": 3}, 200, seed=1
        )
        assert {tile.sensor for tile in backgrounds.tiles("train")} == {Sensor(blur_px, 0.004)}
        pictures = [backgrounds.pixels(tile.id) for tile in backgrounds.tiles("train")]
        measured.append(measure_sensor(pictures).blur_sigma_px)
    assert measured[0] + 0.1 < measured[1]


def test_rendering_and_attacks_use_it(folder, tmp_path):
    backgrounds = BackgroundSet.open(folder)
    place = scene((0.0, 0.0, 0.0))
    place = dataclasses.replace(place, background=window("train"))
    with open_renderer(Rendering(), backgrounds, tmp_path / "out") as renderer:
        record = renderer.record([place])
    assert (record["blur_sigma_px"], record["noise"]) == (ROUNDED_PX, 0.02)
    fleet = sample_fleet(FleetSettings(count=1), generator=torch.Generator().manual_seed(0))
    fleet.save(tmp_path / "fleet")
    world = World.open(folder, tmp_path / "fleet", size_px=128)
    record = world.renderer.record(world.step_scenes(2, seed=0, step=1))
    assert (record["blur_sigma_px"], record["noise"]) == (ROUNDED_PX, 0.02)


@pytest.mark.parametrize("values", [(-1.0, 0.0), (float("nan"), 0.0), (1.0, 2.0)])
def test_refuses_impossible_values(values):
    with pytest.raises(ConfigurationError, match="expects a number from 0 up to"):
        Sensor(*values)


def test_a_damaged_sensor_is_one_sentence(folder):
    index = json.loads((folder / "index.json").read_text())
    for damaged in ({"blur_sigma_px": -3}, {"sharpness": 1}, [1]):
        (folder / "index.json").write_text(json.dumps({**index, "sensor": damaged}))
        with pytest.raises(StoredFileError, match=r"index\.json, sensor"):
            BackgroundSet.open(folder)
