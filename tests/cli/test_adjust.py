"""`skyproof adjust` on a small background set."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.main import run
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sensor import Sensor
from tests.imagery.made import tile as cut
from tests.imagery.made import write_image


@pytest.fixture
def folder(tmp_path):
    write_procedural_backgrounds(tmp_path / "ground", {"train": 2}, 200, seed=0)
    return tmp_path / "ground"


def sensors(folder):
    backgrounds = BackgroundSet.open(folder)
    return [tile.sensor or backgrounds.sensor for tile in backgrounds.tiles("train")]


def test_measures_and_keeps_the_rest(folder):
    before = json.loads((folder / "index.json").read_text())
    assert run(["adjust", str(folder), "--measure-sensor"]) == 0
    after = json.loads((folder / "index.json").read_text())
    first, second = sensors(folder)
    assert first == second == BackgroundSet.open(folder).sensor
    assert 0.4 < first.blur_sigma_px < 1.0
    for index in (before, after):
        for place in (index, *index["tiles"]):
            del place["sensor"]
    assert after == before


def test_the_sensor_is_measured_on_tiles_of_every_split_as_when_they_were_cut(tmp_path):
    checks = np.kron(np.indices((20, 20)).sum(0) % 2, np.ones((32, 32)))
    light = ndimage.gaussian_filter(np.where(checks > 0, 0.5, 0.1), 1.0)
    srgb = ((1.055 * light ** (1 / 2.4) - 0.055) * 255).round().astype(np.uint8)
    write_image(tmp_path / "a.tif", np.repeat(srgb[None], 3, 0))
    backgrounds, _ = cut([tmp_path / "a.tif"], tmp_path / "set", source_gsd_m=0.125)
    assert backgrounds.sensor.blur_sigma_px == pytest.approx(1.0, rel=0.1)
    assert run(["adjust", str(tmp_path / "set"), "--measure-sensor"]) == 0
    assert BackgroundSet.open(tmp_path / "set").sensor == backgrounds.sensor
    for tile in backgrounds.tiles("train"):
        Image.new("RGB", (64, 64)).save(tmp_path / "set" / tile.file)
    assert run(["adjust", str(tmp_path / "set"), "--measure-sensor"]) == 0
    blur_sigma_px = BackgroundSet.open(tmp_path / "set").sensor.blur_sigma_px
    assert blur_sigma_px == pytest.approx(1.0, rel=0.1)


def test_what_is_given_is_taken(folder, capsys):
    assert run(["adjust", str(folder), "--blur-sigma-px", "1.1", "--noise", "0.01"]) == 0
    assert sensors(folder) == [Sensor(1.1, 0.01)] * 2
    assert capsys.readouterr().out.startswith("Blur 1.1 px, noise 0.01: ")
    assert run(["adjust", str(folder), "--blur-sigma-px", "paper"]) == 0
    assert sensors(folder) == [Sensor(2.4, 0.01)] * 2


def test_what_is_not_given_stays(folder, capsys):
    before = sensors(folder)
    assert before[0].noise != before[1].noise
    assert run(["adjust", str(folder), "--blur-sigma-px", "1.1"]) == 0
    assert sensors(folder) == [Sensor(1.1, own.noise) for own in before]
    low, high = sorted(own.noise for own in before)
    assert f"Blur 1.1 px, noise {low:g} to {high:g}: " in capsys.readouterr().out
    assert run(["adjust", str(folder), "--measure-sensor", "--noise", "0.02"]) == 0
    for sensor in sensors(folder):
        assert 0.4 < sensor.blur_sigma_px < 1.0
        assert sensor.noise == 0.02


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--blur-sigma-px", "-1", "--noise", "0"], "expects paper or a number from 0 up to 10"),
        (["--measure-sensor"], "at least 100 clear edges"),
        ([], "Nothing to adjust"),
    ],
)
def test_bad_input(folder, capsys, options, sentence):
    before = (folder / "index.json").read_bytes()
    for tile in BackgroundSet.open(folder).tiles("train"):
        Image.fromarray(torch.full((200, 200, 3), 90, dtype=torch.uint8).numpy()).save(
            folder / tile.file
        )
    assert run(["adjust", str(folder), *options]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert (folder / "index.json").read_bytes() == before
