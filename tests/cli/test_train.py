"""`skyproof train`: further from a detector folder, on several datasets."""

import json
import shutil
from pathlib import Path

import torch

from skyproof.detectors.loaded import load_detector
from skyproof.files import write_json
from tests.cli.conftest import Skyproof, bytes_of

FEW = ("--settings.steps", 1, "--settings.batch-size", 2, "--settings.learning-rate", 1e-6)


def test_a_detector_is_trained_further_on_several_datasets(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    parent = finished / "detectors/retinanet"
    before = bytes_of(parent)
    data = [finished / "datasets/train", finished / "datasets/validation"]
    # A folder of the name of a detector changes nothing.
    (tmp_path / "retinanet").mkdir()
    for name, detector in (("further", parent), ("fresh", "retinanet")):
        answer = skyproof(
            *("train", "--detector", detector, "--data", *data, "--validation", data[1]),
            *("--out", tmp_path / name, *FEW),
        )
        assert answer.code == 0, answer.err
    assert bytes_of(parent) == before
    old, further, fresh = (
        load_detector(p) for p in (parent, tmp_path / "further", tmp_path / "fresh")
    )
    count = sum(len(json.loads((d / "annotations.json").read_text())["images"]) for d in data)
    assert further.card.training["images"] == count
    assert further.card.training["identity"]["parent_sha256"] == old.weights_sha256
    assert "parent_sha256" not in fresh.card.training["identity"]

    def distance(detector: torch.nn.Module) -> float:
        pairs = zip(detector.parameters(), old.parameters(), strict=True)
        return max(float((one - other).abs().max()) for one, other in pairs)

    assert 0 < distance(further) < 1e-4 < distance(fresh)


def test_what_cannot_be_trained_so_is_refused(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    data, out = finished / "datasets/train", tmp_path / "out"
    coarse = shutil.copytree(data, tmp_path / "coarse")
    document = json.loads((coarse / "annotations.json").read_text())
    write_json(
        coarse / "annotations.json", {**document, "info": {**document["info"], "gsd_m": 0.3}}
    )
    call = ("train", "--validation", data, "--out", out, "--detector")
    skyproof(*call, "retinanet", "--data", data, coarse).refused(
        f"{coarse} is of 0.3 m per pixel and {data} of 0.125", "resample one of them"
    )
    skyproof(*call, tmp_path / "none", "--data", data).refused("or the folder of one", "none slim")
    skyproof(*call, data, "--data", data).refused("detector.json")
    assert not out.exists()
