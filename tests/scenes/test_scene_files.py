"""Scenes as JSON lines."""

import json

import pytest

from skyproof.errors import StoredFileError
from skyproof.scenes.scene import (
    BackgroundWindow,
    Camera,
    Placement,
    Scene,
    Sun,
    read_scenes,
    write_scenes,
)


def _scene(number: int) -> Scene:
    return Scene(
        id=f"scene-{number}",
        background=BackgroundWindow("tile-1", 100.25, 90.5, 0.1 * number),
        camera=Camera(0.1, 2.0, 0.125, 384),
        sun=Sun(1.0, 0.7),
        placements=(Placement("vän", 1.0, -2.0, 3.0),) * number,
        seed=2**63 - 2 - number,
    )


def test_round_trip_keeps_every_field(tmp_path):
    scenes = [_scene(number) for number in range(4)]
    write_scenes(tmp_path / "scenes.jsonl", scenes)
    assert read_scenes(tmp_path / "scenes.jsonl") == scenes


@pytest.mark.parametrize("text", ['{"id": "a"}\n', "not json\n", "[1]\n"])
def test_damaged_file_raises(tmp_path, text):
    path = tmp_path / "scenes.jsonl"
    path.write_text(text)
    with pytest.raises(StoredFileError, match=r"scenes\.jsonl"):
        read_scenes(path)


def test_missing_file_raises(tmp_path):
    with pytest.raises(StoredFileError, match="missing"):
        read_scenes(tmp_path / "none.jsonl")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"id": "../../../victim/holiday"}, r"line 2, id: expected a plain name"),
        ({"id": "/tmp/holiday"}, r"line 2, id: expected a plain name"),
        ({"seed": 2**64}, r"line 2, seed: expected a whole number of at most 64 bits"),
        ({"placements": [{}] * 1001}, r"line 2, placements: expected a list of length <= 1000"),
        ({"camera": {"tilt_rad": 1.6}}, r"line 2, camera\.tilt_rad: expected a number <= 1\.5"),
        ({"camera": {"gsd_m": 1e-9}}, r"line 2, camera\.gsd_m: expected a number >= 0\.001"),
        ({"camera": {"size_px": 10**6}}, r"line 2, camera\.size_px: expected a whole number <="),
        ({"sun": {"elevation_rad": 0}}, r"line 2, sun\.elevation_rad: expected a number >= 0\.01"),
        ({"placements": [{"x_m": 1e300}]}, r"line 2, placements\[0\]\.x_m: expected a number <="),
        ({"weather": {"jpeg_quality": 0}}, r"line 2, weather\.jpeg_quality: expected"),
        ({"wether": {}}, "there is no field 'wether'"),
        ({"id": "scene-1"}, "two scenes called 'scene-1'"),
        ({"camera": {"size_px": 99}}, "several image sizes"),
    ],
)
def test_a_scene_that_cannot_be_is_one_sentence_with_its_place(tmp_path, change, words):
    path = tmp_path / "scenes.jsonl"
    write_scenes(path, [_scene(1), _scene(2)])
    first, second = map(json.loads, path.read_text().splitlines())
    for name, value in change.items():
        if isinstance(value, dict) and name in second:
            second[name].update(value)
        elif name == "placements":
            second[name] = [{**second[name][0], **one} for one in value]
        else:
            second[name] = value
    path.write_text(f"{json.dumps(first)}\n{json.dumps(second)}\n")
    with pytest.raises(StoredFileError, match=words) as caught:
        read_scenes(path)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).endswith("; copy the file again, or sample the scenes again.")
