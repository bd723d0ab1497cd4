"""Detector folders: round trip, and one clear sentence for every kind of damage."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from detector_images import NAMES
from safetensors.torch import load_file, save_file

from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard, read_card
from skyproof.detectors.detector import Detections
from skyproof.detectors.loaded import (
    build_detector,
    copy_detector,
    load_detector,
    load_ensemble,
    save_detector,
)
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.storage import weights_digest

CARD = DetectorCard(
    name="retinanet",
    size="slim",
    threshold=0.42,
    gsd_m=0.125,
    image_size_px=(96, 128),
    parameters=7,
    training={"images": 3},
    validation={"ap_centre_1m": 0.9, "ap_iou_50": 0.8, "f1": 0.7},
    skyproof_version="0.1.0",
)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stored") / "detector"
    save_detector(
        folder,
        build_detector("retinanet", "slim", generator=torch.Generator().manual_seed(1)),
        CARD,
    )
    return folder


@pytest.fixture
def folder(stored: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(stored, tmp_path / "copy"))


def test_round_trip(folder: Path) -> None:
    original = build_detector(
        "retinanet", "slim", generator=torch.Generator().manual_seed(1)
    ).eval()
    detector = load_detector(folder)
    assert detector.card == CARD == read_card(folder)
    assert not detector.training
    assert weights_digest(detector) == weights_digest(original)
    images = torch.rand(2, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    assert torch.equal(detector.candidates(images).scores, original.candidates(images).scores)
    assert sorted(path.name for path in folder.iterdir()) == [
        "detector.json",
        "weights.safetensors",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_a_network_comes_back_from_its_folder_and_fits_no_other_size(
    name: str, tmp_path: Path
) -> None:
    original = build_detector(name, "slim", generator=torch.Generator().manual_seed(1))
    card = replace(CARD, name=name, size="slim")
    save_detector(tmp_path, original, card)
    loaded = load_detector(tmp_path)
    assert loaded.card == card
    assert weights_digest(loaded) == weights_digest(original)
    save_detector(tmp_path, original, replace(card, size="full"))
    with pytest.raises(StoredFileError, match=f"does not fit a full {name}"):
        load_detector(tmp_path)


def test_digest_sees_parameters_and_buffers(stored: Path) -> None:
    detector = load_detector(stored)
    digest = weights_digest(detector)
    buffer = next(
        buffer for name, buffer in detector.named_buffers() if name.endswith("running_mean")
    )
    buffer.add_(1e-6)
    assert weights_digest(detector) != digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format 2"),
        ({"format": None}, "format None"),
        ({"name": "ssd"}, "unknown detector"),
        ({"size": "full size"}, "unknown detector"),
        ({"name": "faster_rcnn"}, "does not fit"),
        ({"threshold": "high"}, "threshold: expected a number, got text"),
        ({"threshold": 1e300}, "threshold: expected a number <= 1"),
        ({"gsd_m": 0}, "gsd_m: expected a number >= 0.001"),
        ({"name": "../../x"}, "name: expected a plain name"),
        ({"image_size_px": [10**9, 1]}, r"image_size_px\[0\]: expected a whole number <= 16384"),
        ({"brought": {"kind": "torchvision"}}, "brought: the field architecture is missing"),
        ({"thresold": 0.5}, "no field 'thresold'"),
        ({"weights_sha256": "0"}, "not the file"),
        ({"weights_sha256": ""}, "lacks the weights_sha256"),
    ],
)
def test_other_contents_of_detector_json(folder: Path, change: dict, message: str) -> None:
    record = json.loads((folder / "detector.json").read_text())
    (folder / "detector.json").write_text(json.dumps(record | change))
    with pytest.raises(StoredFileError, match=message):
        load_detector(folder)


def test_missing_field_and_missing_files(folder: Path) -> None:
    record = json.loads((folder / "detector.json").read_text())
    del record["gsd_m"]
    (folder / "detector.json").write_text(json.dumps(record))
    with pytest.raises(StoredFileError, match="gsd_m"):
        read_card(folder)
    (folder / "detector.json").write_text("[1]")
    with pytest.raises(
        StoredFileError, match=r"detector\.json cannot be used: expected an object, got a list"
    ):
        read_card(folder)
    (folder / "detector.json").unlink()
    with pytest.raises(StoredFileError, match="missing"):
        load_detector(folder)


def test_missing_or_damaged_weights(folder: Path) -> None:
    path = folder / "weights.safetensors"
    tensors = load_file(path)
    name = next(iter(tensors))
    for damaged in (
        {**tensors, name: torch.zeros(3)},
        {key: value for key, value in tensors.items() if key != name},
    ):
        save_file(damaged, path)
        with pytest.raises(StoredFileError, match="does not fit"):
            load_detector(folder)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(StoredFileError, match="damaged"):
        load_detector(folder)
    path.unlink()
    with pytest.raises(StoredFileError, match="missing"):
        load_detector(folder)


def test_an_ensemble_is_of_different_detectors_of_the_images_resolution(folder: Path) -> None:
    (loaded,) = load_ensemble([folder], "cpu", 0.125)
    assert (loaded.name, loaded.threshold) == ("retinanet", 0.42)
    with pytest.raises(ConfigurationError, match="second retinanet"):
        load_ensemble([folder, folder], "cpu", 0.125)
    with pytest.raises(ConfigurationError, match=r"0\.125 m per pixel but the images have 0\.25"):
        load_ensemble([folder], "cpu", 0.25)


class Blind:
    """A black box that finds nothing."""

    name = "mine"

    def detect(self, images: torch.Tensor) -> list[Detections]:
        return [Detections(torch.empty(0, 4), torch.empty(0)) for _ in images]


def test_a_detector_is_no_pair() -> None:
    # `detector, threshold = ...` once bound a card to the name of a threshold.
    black_box = BlackBoxDetector(Blind(), card=DetectorCard("mine", threshold=0.5, gsd_m=0.2))
    assert (black_box.name, black_box.threshold, black_box.card.gsd_m) == ("mine", 0.5, 0.2)
    with pytest.raises(TypeError):
        _, _ = black_box  # type: ignore[misc]


def test_a_copy_has_what_belongs_to_a_detector_and_nothing_from_elsewhere(
    folder: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("nobody else's")
    (folder / "notes.txt").symlink_to(secret)
    (folder / "steps.jsonl").write_text("{}\n")
    copy_detector(folder, tmp_path / "plain")
    copied = {path.name for path in (tmp_path / "plain").iterdir()}
    assert copied == {"weights.safetensors", "detector.json"}
    assert load_detector(tmp_path / "plain").card == CARD
    copy_detector(folder, tmp_path / "logged", ["steps.jsonl", "precheck.json"])
    assert (tmp_path / "logged" / "steps.jsonl").is_file()
    (folder / "steps.jsonl").unlink()
    (folder / "steps.jsonl").symlink_to(secret)
    with pytest.raises(StoredFileError, match="leads out of its folder"):
        copy_detector(folder, tmp_path / "stolen", ["steps.jsonl"])
