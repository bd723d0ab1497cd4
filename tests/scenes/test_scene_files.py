"""Scenes as JSON lines."""

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
