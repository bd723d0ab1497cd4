"""The sensor of a background set decides how vehicles are drawn on it."""

import json

import pytest
import torch

from skyproof.attacks.world import AttackWorld
from skyproof.cli.renderers import open_renderer
from skyproof.cli.rendering import Rendering
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet, BackgroundTile, save_tile, write_index
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import FleetSettings, sample_fleet


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


def test_old_sets_have_the_papers_blur(folder):
    index = json.loads((folder / "index.json").read_text())
    del index["sensor"]
    (folder / "index.json").write_text(json.dumps(index))
    assert BackgroundSet.open(folder).sensor == Sensor(2.4, 0.006) == Sensor()
    assert RenderSettings.of(Sensor()) == RenderSettings()


def test_rendering_and_attacks_use_it(folder, tmp_path):
    with open_renderer(Rendering(), BackgroundSet.open(folder), tmp_path / "out") as renderer:
        assert (renderer.record()["blur_sigma_px"], renderer.record()["noise"]) == (0.8, 0.02)
    fleet = sample_fleet(FleetSettings(count=1), generator=torch.Generator().manual_seed(0))
    fleet.save(tmp_path / "fleet")
    world = AttackWorld.open(folder, tmp_path / "fleet", size_px=128)
    assert (world.renderer.settings.blur_sigma_px, world.renderer.settings.noise) == (0.8, 0.02)


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
