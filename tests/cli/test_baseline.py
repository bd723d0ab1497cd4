"""`skyproof score --frames`: detectors checked on rendered and on annotated images."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import match_images
from skyproof.detectors.validation import average_precision
from skyproof.main import run


@pytest.fixture
def frames(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("a", "b"):
        pixels = np.random.default_rng(0).integers(60, 190, (160, 200, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.png")
        (folder / f"{name}.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    (folder / "names.names").write_text("car\nminibus\n")
    return folder


def test_writes_a_row_per_detector_and_set(finished, frames, tmp_path, capsys):
    detector, out = finished / "detectors" / "retinanet", tmp_path / "scores"
    options = ["--frames", f"Town={frames}/a*@0.125", f"Town={frames}/b*@0.125", f"{frames}@0.125"]
    assert run(["score", "--detectors", str(detector), *options, "--out", str(out)]) == 0
    rows = json.loads((out / "baselines.json").read_text())["rows"]
    assert [
        (row["dataset"], row["vehicles"], row["clustered_by"], row["clusters"]) for row in rows
    ] == [
        ("Town", 2, "places", 2),
        ("frames", 2, "images", 2),
    ]
    assert all(row["detector"] == "retinanet" and 0 <= row["ap_centre_1m"] <= 1 for row in rows)
    assert "Town" in capsys.readouterr().out


def test_agrees_with_the_average_precision_of_the_same_images(finished, tmp_path):
    detector, out = finished / "detectors" / "retinanet", tmp_path / "scores"
    options = [
        "--frames",
        f"{finished / 'datasets' / 'validation'}@0.125",
        "--frame-classes",
        "vehicle",
    ]
    assert run(["score", "--detectors", str(detector), *options, "--out", str(out)]) == 0
    (row,) = json.loads((out / "baselines.json").read_text())["rows"]
    images = Dataset.open(finished / "datasets" / "validation")
    found = detect_all(load_detector(detector), images)
    expected = average_precision(match_images(found, images, criterion="centre_1m"))
    assert row["ap_centre_1m"] == pytest.approx(expected, abs=1e-6)
    assert not row["real"]


def test_bad_input(finished, frames, tmp_path, capsys):
    detector, out = finished / "detectors" / "retinanet", tmp_path / "scores"
    coarser = tmp_path / "coarser"
    shutil.copytree(detector, coarser)
    card = json.loads((coarser / "detector.json").read_text())
    (coarser / "detector.json").write_text(json.dumps({**card, "gsd_m": 0.25}))
    given = ["--frames", f"{frames}@0.125", "--out", str(out)]
    assert run(["score", "--detectors", str(detector), str(coarser), *given]) == 2
    assert "of one resolution" in " ".join(capsys.readouterr().err.split())
    assert run(["score", "--detectors", str(detector), "--out", str(out)]) == 2
    assert "--frames" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
    out.write_text("{}")
    assert run(["score", "--detectors", str(detector), *given]) == 2
    assert out.read_text() == "{}"


def test_detectors_of_one_kind_go_by_their_folders(finished, frames, tmp_path):
    detector, out = finished / "detectors" / "retinanet", tmp_path / "scores"
    other = shutil.copytree(detector, tmp_path / "later")
    given = ["--frames", f"{frames}@0.125", "--out", str(out)]
    assert run(["score", "--detectors", str(detector), str(other), *given]) == 0
    rows = json.loads((out / "baselines.json").read_text())["rows"]
    assert [row["detector"] for row in rows] == ["retinanet", "later"]
