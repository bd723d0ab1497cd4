"""A checkpoint is imported and then used by other commands like any detector."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_fpn

from skyproof.assessment.subject import _digest
from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.detectors.card import read_card
from skyproof.words import detector_name
from tests.cli.conftest import Skyproof
from tests.transformers_folders import needs_transformers, write_folder

CPU = ["--device", "cpu"]
KIND = ["--kind", "torchvision", "--architecture", "fasterrcnn_mobilenet_v3_large_fpn"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("checkpoint") / "vehicles.pth"
    model = fasterrcnn_mobilenet_v3_large_fpn(weights=None, weights_backbone=None, num_classes=4)
    torch.save({"model": model.state_dict()}, path)
    return path


@pytest.mark.slow
def test_an_imported_detector_is_used_like_any_other(
    checkpoint: Path, finished: Path, worn: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    out = tmp_path / "theirs"
    call = [
        "import",
        checkpoint,
        *KIND,
        "--vehicle-classes",
        1,
        3,
        "--validation",
        finished / "datasets/validation",
    ]
    answer = skyproof(*call, "--out", out, *CPU)
    assert answer.code == 0, answer.err
    assert "threshold" in answer.out
    # It was never trained.
    assert "Warning: theirs reaches a validation AP of 0.0" in answer.out
    assert read_card(out).name == "theirs"
    stored = (out / "weights.safetensors").read_bytes()
    skyproof(*call, "--out", out).refused(str(out), "not overwritten")
    # Untrained, it needs a threshold at which it finds something on the test images.
    record = json.loads((out / "detector.json").read_text())
    (out / "detector.json").write_text(json.dumps({**record, "threshold": 0.01}))
    both = ["--detectors", finished / "detectors/retinanet", out]
    answer = skyproof(
        "score",
        *both,
        "--original",
        finished / "datasets/test",
        "--camouflages",
        finished / "camouflages/T-U",
        "--backgrounds",
        finished / "backgrounds",
        "--fleet",
        finished / "fleets/test",
        "--out",
        tmp_path / "e",
        *CPU,
    )
    assert answer.code == 0, answer.err
    assert "theirs" in answer.out
    world = ["--backgrounds", finished / "backgrounds", "--fleet", finished / "fleets/attack"]
    steps = [
        "--settings.steps",
        2,
        "--settings.batch-size",
        1,
        "--settings.balance-batches",
        1,
        *CPU,
    ]
    answer = skyproof("attack", "T-U", *both, *world, "--out", tmp_path / "made", *steps)
    assert answer.code == 0, answer.err
    losses = json.loads((tmp_path / "made" / "T-U" / "steps.jsonl").read_text().splitlines()[0])[
        "losses"
    ]
    assert set(losses) == {"retinanet", "theirs"}
    assert all(0 < value < 100 for value in losses.values())
    assert (out / "weights.safetensors").read_bytes() == stored


def test_bad_input(checkpoint: Path, finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    validation = ["--validation", finished / "datasets/validation"]
    good = [checkpoint, *KIND, "--vehicle-classes", 1, *validation]
    text = tmp_path / "text.pth"
    text.write_text("not weights")
    for call, words in (
        ([text, *good[1:]], (str(text), "not a checkpoint")),
        ([tmp_path / "none.pth", *good[1:]], ("none.pth", "missing")),
        ([*good, "--vehicle-classes", "car"], ("from 1 to 3", "car")),
        ([*good, "--architecture", "yolo"], ("fcos_resnet50_fpn",)),
        ([*good, "--kind", "ultralytics"], ("--architecture",)),
        ([*good, "--gsd", -1], ("--gsd",)),
        ([*good, "--name", "a/b"], ("--name",)),
        ([*good, "--validation", tmp_path / "nowhere"], ("nowhere", "missing")),
        ([*good, "--device", "abacus"], ("--device",)),
    ):
        skyproof("import", *call, "--out", tmp_path / "x").refused(*words)
        assert not (tmp_path / "x").exists()


def tiled(folder: Path) -> Path:
    """Tiles as real imagery gives them: grey and coloured, of two sizes, some with vehicles."""
    draws = np.random.default_rng(0)
    rows = []
    for split in ("train", "validation"):
        with CocoWriter(
            folder / split, gsd_m=0.125, source={"description": "skyproof tiles"}
        ) as writer:
            for index, side in enumerate((384, 384, 500, 200)):
                array = draws.integers(60, 90, (side, side, 3), dtype=np.uint8)
                marks = []
                if index % 2 == 0:
                    array[100:115, 50:86] = 220
                    marks.append(Annotation((50.0, 100.0, 86.0, 115.0), (68.0, 107.5)))
                    marks.append(Annotation((150.0, 20.0, 170.0, 60.0), (160.0, 40.0), ignore=True))
                name = f"{split}{index}"
                writer.add(torch.from_numpy(array).permute(2, 0, 1), name, marks)
                place = f"{split}/images/{name}.png"
                if index == 2:
                    # A single band is a picture too.
                    Image.open(folder / place).convert("L").save(folder / place)
                rows.append(
                    {"id": name, "file": place, "split": split, "width_px": side, "height_px": side}
                    | {"source": f"city_{index % 2}.tif", "offset_px": [0, 0]}
                )
    index = {"format_version": 1, "gsd_m": 0.125, "tiles": rows}
    (folder / "index.json").write_text(json.dumps(index))
    return folder


@pytest.mark.parametrize("detector", ["retinanet", "faster_rcnn"])
def test_training_on_real_tiles(detector: str, tmp_path: Path, skyproof: Skyproof) -> None:
    folder = tiled(tmp_path / "tiles")
    call = [
        "train",
        "--detector",
        detector,
        "--data",
        folder / "train",
        "--validation",
        folder / "validation",
    ]
    answer = skyproof(
        *call, "--settings.steps", 1, "--settings.batch-size", 2, "--out", tmp_path / "out", *CPU
    )
    assert answer.code == 0, answer.err
    card = read_card(tmp_path / "out")
    assert f"Warning: {detector_name(detector)} reaches a validation AP of" in answer.out
    assert f"chosen on {card.validation_vehicles} vehicles" in answer.out
    assert card.trained_on == "train: tiles of real imagery (city_0.tif, city_1.tif)"
    assert card.image_size_px == (384, 384)


def test_what_a_detector_was_trained_on(finished: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    assert (
        read_card(finished / "detectors/retinanet").trained_on
        == "train: rendered by the differentiable renderer"
    )
    folder = tiled(tmp_path / "tiles")
    shutil.move(folder / "train", tmp_path / "alone")
    call = [
        "train",
        "--detector",
        "retinanet",
        "--data",
        tmp_path / "alone",
        "--validation",
        folder / "validation",
    ]
    assert (
        skyproof(
            *call,
            "--settings.steps",
            1,
            "--settings.batch-size",
            1,
            "--out",
            tmp_path / "out",
            *CPU,
        ).code
        == 0
    )
    assert read_card(tmp_path / "out").trained_on == "alone: images of unknown origin"


@needs_transformers
def test_a_folder_of_transformers_is_taken_as_it_is(
    finished: Path, tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = tmp_path / "theirs"
    write_folder(theirs, "rt_detr")
    plan = ["assess", theirs, "--plan", "--out", tmp_path / "run"]
    skyproof(*plan).refused("--vehicle-classes")
    skyproof(*plan, "--vehicle-classes", "truck").refused("car, van, boat", "truck")
    answer = skyproof(*plan, "--vehicle-classes", "van", "car")
    assert answer.code == 0, answer.err
    call = ["import", theirs, "--kind", "transformers", "--vehicle-classes", "van"]
    call += ["--validation", finished / "datasets/validation"]
    skyproof(*call, "--architecture", "fcos_resnet50_fpn", "--out", tmp_path / "x").refused(
        "--architecture"
    )
    # An untrained network finds vehicles by luck alone.
    scores = {"ap_centre_1m": 0.5, "ap_iou_50": 0.4, "f1": 0.6, "threshold": 0.3}
    monkeypatch.setattr("skyproof.detectors.validation._scores", lambda *_: dict(scores))
    answer = skyproof(*call, "--out", tmp_path / "ours", *CPU)
    assert answer.code == 0, answer.err
    assert read_card(tmp_path / "ours").trained_on.startswith("elsewhere: transformers checkpoint")
    # A changed file beside the weights is a changed detector.
    digest = _digest(theirs / "model.safetensors")
    (theirs / "preprocessor_config.json").write_text("{}")
    assert _digest(theirs / "model.safetensors") != digest
    skyproof(*plan, "--vehicle-classes", "van").refused("preprocessor_config.json", "size")
