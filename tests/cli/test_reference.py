"""Detectors that come trained: a name for a folder, refused if damaged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skyproof.detectors import card
from skyproof.detectors.card import (
    HARDENED_DETECTORS,
    REFERENCE_DETECTORS,
    REFERENCE_FOLDER,
    detector_folder,
)
from skyproof.detectors.loaded import load_detector
from tests.cli.conftest import Skyproof, bytes_of

FILES = {"precheck.json", "detector.json", "weights.safetensors"}


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of what comes with skyproof, in its place."""
    folder = Path(shutil.copytree(REFERENCE_FOLDER, tmp_path / "came"))
    monkeypatch.setattr(card, "REFERENCE_FOLDER", folder)
    return folder


def test_a_name_serves_wherever_a_folder_does(
    finished: Path, tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in REFERENCE_DETECTORS:
        assert load_detector(name).name == name
        assert detector_folder(name) == REFERENCE_FOLDER / name
    frames = ["--frames", f"{finished / 'datasets/validation'}@0.125", "--frame-classes", "vehicle"]
    answer = skyproof(
        *("score", "--detectors", *REFERENCE_DETECTORS, "--out", tmp_path / "new"),
        *(*frames, "--device", "cpu"),
    )
    assert answer.code == 0, answer.err
    # A folder of the user's that is called so goes first.
    monkeypatch.chdir(tmp_path)
    shutil.copytree(REFERENCE_FOLDER / "faster_rcnn", "retinanet")
    assert load_detector("retinanet").name == "faster_rcnn"
    # Whoever names none of them is told which there are.
    skyproof("assess", "yolov5", "--out", "run").refused("yolov5 is not there", "faster_rcnn")


def test_the_folders_hold_what_a_detector_folder_holds() -> None:
    for name in REFERENCE_DETECTORS:
        assert set(bytes_of(REFERENCE_FOLDER / name)) == FILES
    for name in HARDENED_DETECTORS:
        assert detector_folder(name) == REFERENCE_FOLDER / name
        assert set(bytes_of(REFERENCE_FOLDER / name)) == {*FILES, "parent.json"}


def _halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


def _of_another_version(path: Path) -> None:
    card = path.with_name("detector.json")
    card.write_text(json.dumps({**json.loads(card.read_text()), "format": 2}))


def _of_another_network(path: Path) -> None:
    shutil.copy(path.parents[1] / "faster_rcnn" / path.name, path)


def _changed(path: Path) -> None:
    data = np.fromfile(path, np.uint8)
    data[-1] ^= 1
    data.tofile(path)


@pytest.mark.parametrize("name", ["retinanet", "retinanet_hardened"])
@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (_halved, "weights.safetensors is damaged"),
        (Path.unlink, "weights.safetensors is missing"),
        (_of_another_version, "format 2"),
        (_of_another_network, "does not fit a slim retinanet"),
        (_changed, "not the file that detector.json was written for"),
    ],
)
def test_damaged_or_of_another_version_is_one_sentence(
    elsewhere: Path,
    tmp_path: Path,
    skyproof: Skyproof,
    harm: Callable[[Path], None],
    told: str,
    name: str,
) -> None:
    harm(elsewhere / name / "weights.safetensors")
    out = tmp_path / "run"
    skyproof("demo", "--out", out, "--device", "cpu").refused(told, "install skyproof again")
    assert not (out / "detectors").exists()
