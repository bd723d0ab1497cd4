"""`skyproof adjust` on a small background set."""

import json

import pytest
import torch
from PIL import Image

from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.main import run
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sensor import Sensor


@pytest.fixture
def folder(tmp_path):
    write_procedural_backgrounds(tmp_path / "ground", {"train": 2}, 200, seed=0)
    return tmp_path / "ground"


def test_measures_and_keeps_the_rest(folder):
    before = json.loads((folder / "index.json").read_text())
    assert run(["adjust", str(folder), "--measure-sensor"]) == 0
    after = json.loads((folder / "index.json").read_text())
    assert 0.4 < after["sensor"]["blur_sigma_px"] < 1.0
    assert {**after, "sensor": before["sensor"]} == before


def test_what_is_given_is_taken(folder):
    assert run(["adjust", str(folder), "--blur-sigma-px", "1.1", "--noise", "0.01"]) == 0
    assert BackgroundSet.open(folder).sensor == Sensor(1.1, 0.01)


def test_what_is_not_given_stays(folder):
    before = BackgroundSet.open(folder).sensor
    assert run(["adjust", str(folder), "--blur-sigma-px", "1.1"]) == 0
    assert BackgroundSet.open(folder).sensor == Sensor(1.1, before.noise)
    assert run(["adjust", str(folder), "--measure-sensor", "--noise", "0.02"]) == 0
    sensor = BackgroundSet.open(folder).sensor
    assert 0.4 < sensor.blur_sigma_px < 1.0
    assert sensor.noise == 0.02


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--blur-sigma-px", "-1", "--noise", "0"], "expects a number from 0 up to 10"),
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
