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
    call = ("train", "--detector", "retinanet", "--data", *data, "--validation", data[1], *FEW)
    for name, start in (("further", ("--from", parent)), ("fresh", ())):
        answer = skyproof(*call, "--out", tmp_path / name, *start)
        assert answer.code == 0, answer.err
    assert bytes_of(parent) == before
    old, further, fresh = map(load_detector, (parent, tmp_path / "further", tmp_path / "fresh"))
    count = sum(len(json.loads((d / "annotations.json").read_text())["images"]) for d in data)
    assert further.card.training["images"] == count
    assert further.card.training["identity"]["parent_sha256"] == old.weights_sha256
    assert "parent_sha256" not in fresh.card.training["identity"]
    images = "train: rendered by the differentiable renderer; validation: rendered by the"
    assert fresh.card.trained_on.startswith(images)
    assert further.card.trained_on == f"{old.card.trained_on}; {fresh.card.trained_on}"

    def distance(detector: torch.nn.Module) -> float:
        pairs = zip(detector.parameters(), old.parameters(), strict=True)
        return max(float((one - other).detach().abs().max()) for one, other in pairs)

    assert 0 < distance(further) < 1e-4 < distance(fresh)
    skyproof(*call, "--out", tmp_path / "fresh", "--from", parent).refused("another --out")


def test_what_cannot_be_trained_so_is_refused(
    finished: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    data, out = finished / "datasets/train", tmp_path / "out"
    parent = finished / "detectors/retinanet"
    coarse = shutil.copytree(data, tmp_path / "coarse")
    document = json.loads((coarse / "annotations.json").read_text())
    coarser = {**document, "info": {**document["info"], "gsd_m": 0.3}}
    write_json(coarse / "annotations.json", coarser)
    call = ("train", "--validation", data, "--out", out, "--detector")
    skyproof(*call, "retinanet", "--data", data, coarse).refused(
        "of one resolution", f"{data} of 0.125 m, {coarse} of 0.3 m"
    )
    skyproof(*call, "retinanet", "--data").refused("datasets of one resolution", "got none")
    skyproof(*call, "yolo9", "--data", data).refused("'yolo9' is no detector", "retinanet")
    skyproof(*call, "retinanet", "--data", data, "--size", "huge").refused("slim, full", "'huge'")
    start = ("--data", data, "--from")
    skyproof(*call, "retinanet", *start, tmp_path / "none").refused("none", "missing")
    skyproof(*call, "faster_rcnn", *start, parent).refused(
        "expects a faster_rcnn slim that skyproof trained, got a retinanet slim"
    )
    skyproof(*call, "retinanet", "--data", coarse, "--from", parent).refused(
        "was trained at 0.125 m per pixel but the images have 0.3 m"
    )
    assert not out.exists()
