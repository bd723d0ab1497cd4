"""`skyproof precheck`: detectors before any attack, and other thresholds frozen."""

import json
import shutil

import pytest

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import PARENT_FILE, read_card
from skyproof.results.precheck import read_precheck
from tests.cli.conftest import Skyproof, bytes_of


@pytest.fixture
def detector(finished, tmp_path):
    """A detector that nobody prechecked."""
    without = shutil.ignore_patterns("precheck.json")
    return shutil.copytree(finished / "detectors/retinanet", tmp_path / "retinanet", ignore=without)


@pytest.fixture
def world(finished):
    scenes = ["--scenes", finished / "scenes/test.jsonl", "--scenes-count", 6, "--draws", 1]
    ground = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/test"]
    return [*ground, *scenes, "--device", "cpu"]


def test_a_detector_of_the_package_is_not_prechecked_in_its_place(
    world, tmp_path, monkeypatch, skyproof: Skyproof
) -> None:
    monkeypatch.chdir(tmp_path)
    skyproof("precheck", "retinanet", *world).refused(
        "retinanet comes with skyproof", "give a detector folder of yours"
    )
    assert not (tmp_path / "retinanet").exists()


def test_a_check_is_shown_stored_and_kept(detector, world, finished, skyproof: Skyproof) -> None:
    frames = ["--frames", f"{finished / 'datasets/validation'}@0.125", "--frame-classes", "vehicle"]
    answer = skyproof("precheck", detector, *world, *frames)
    assert answer.code == 0, answer.err
    for words in ("RetinaNet: ", "rendered scenes", "validation", "precision", "recall"):
        assert words in answer.out
    for words in (
        "27 hide more than",
        "degrees of blur",
        "random controls",
        "elevations of the s",
    ):
        assert words in answer.out
    record = read_precheck(detector)
    card = json.loads((detector / "detector.json").read_text())
    assert (record.weights_sha256, record.threshold) == (card["weights_sha256"], card["threshold"])
    assert (record.measured_on.scenes, record.measured_on.draws) == (6, 1)
    # Shown again, without drawing anything.
    before = bytes_of(detector)
    again = skyproof("precheck", detector, *world, *frames)
    assert again.code == 0
    assert again.out in answer.out
    # Another check does not replace it.
    skyproof("precheck", detector, *world).refused("precheck.json", "other frames", "move it away")
    # Nor one of other images under the same name, if it says which they were.
    images = shutil.copytree(finished / "datasets/test", detector.parent / "validation")
    others = ["--frames", f"{images}@0.125", *frames[2:]]
    skyproof("precheck", detector, *world, *others).refused("images or labels of frames")
    assert bytes_of(detector) == before
    written = json.loads((detector / "precheck.json").read_text())
    for key in ("frames_sha256", "ground_sha256", "fleet_sha256"):
        del written["measured_on"][key]
    (detector / "precheck.json").write_text(json.dumps(written))
    assert skyproof("precheck", detector, *world, *others).code == 0


def test_what_cannot_be_checked_is_said_in_a_sentence(
    detector, world, skyproof: Skyproof, tmp_path
) -> None:
    skyproof("precheck", "--device", "cpu").refused("at least one detector folder")
    skyproof("precheck", detector).refused("--backgrounds and --fleet")
    skyproof("precheck", detector, "--freeze", tmp_path / "new").refused("--frames")
    assert not (tmp_path / "new").exists()
    assert not (detector / "precheck.json").exists()


def test_another_threshold_is_frozen_in_a_copy(
    detector, finished, skyproof: Skyproof, tmp_path
) -> None:
    (detector / PARENT_FILE).write_text("of a hardened detector")
    before = bytes_of(detector)
    frames = ["--frames", f"{finished / 'datasets/test'}@0.125", "--frame-classes", "vehicle"]
    labels = tmp_path / "labels"
    call = ["precheck", detector, "--freeze", labels, *frames, "--device", "cpu"]
    answer = skyproof(*call)
    assert answer.code == 0, answer.err
    best = "the middle of those within a point of the best F1 on test"
    card = read_card(labels)
    assert card.threshold_from == best
    # The card tells of the images that fixed the threshold, not of those before.
    vehicles = sum(map(len, Dataset.open(finished / "datasets/test").boxes))
    assert card.validation_vehicles == vehicles
    digests = [read_card(each).weights_sha256 for each in (labels, detector)]
    assert digests[0] == digests[1]
    assert (labels / PARENT_FILE).read_text() == "of a hardened detector"
    skyproof(*call).refused("exists already")
    assert bytes_of(detector) == before
