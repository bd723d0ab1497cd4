"""`skyproof assess` of an ONNX file: the reference RetinaNet, exported."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torchvision.ops import box_convert

import skyproof as sp
from skyproof.assessment import assess as assess_module
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.onnx_file import OnnxFile
from skyproof.errors import RunFolderError
from tests.cli.conftest import Skyproof
from tests.cli.test_assess import TINY

onnx = pytest.importorskip("onnx", reason="needs onnx (pip install 'skyproof[onnx]')")
pytest.importorskip("onnxruntime", reason="needs onnxruntime (pip install 'skyproof[onnx]')")

SIDE = 128
NAMES = {"names": "{0: 'car', 1: 'shed'}"}


class Columns(torch.nn.Module):
    """The reference RetinaNet with the outputs of Ultralytics, and a class that it never finds."""

    def __init__(self) -> None:
        super().__init__()
        self.detector = load_detector("retinanet")

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        found = self.detector.candidates(images)
        scores = torch.stack([found.scores, 0 * found.scores], dim=1)
        return torch.cat(
            [box_convert(found.boxes, "xyxy", "cxcywh").transpose(1, 2), scores], dim=1
        )


@pytest.fixture(scope="module", autouse=True)
def suite() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        tiny = replace(TINY, attacks=("T-PixFc",), compared=())
        patch.setattr(assess_module, "read_suite", lambda *_: tiny)
        yield


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported network; not to be changed."""
    path = tmp_path_factory.mktemp("exported") / "best.onnx"
    with warnings.catch_warnings(action="ignore"), torch.no_grad():
        image = torch.zeros(1, 3, SIDE, SIDE)
        torch.onnx.export(Columns().eval(), (image,), path, dynamo=False)
    model = onnx.load(path)
    for key, value in NAMES.items():
        model.metadata_props.add(key=key, value=value)
    onnx.save(model, path)
    return path


@pytest.mark.slow
def test_from_an_onnx_file_to_a_report(file: Path, tmp_path: Path, skyproof: Skyproof) -> None:
    mine, out = tmp_path / "best.onnx", tmp_path / "town"
    mine.write_bytes(file.read_bytes())
    call = ["assess", mine, "--vehicle-classes", "car", "--out", out, "--device", "cpu"]
    done = skyproof(*call)
    assert done.code == 0, done.err
    assert "skyproof, town on cpu" in done.out
    card = json.loads((out / "detectors/town/detector.json").read_text())
    assert card["name"] == "town"
    assert card["weights_sha256"] == ""
    assert card["validation"]["f1"] > 0.5
    assert "This detector is a black box" in (out / "report.html").read_text()
    config = json.loads((out / "config.json").read_text())
    assert [*config["sources_sha256"]] == [str(mine)]
    # The same call goes on, from Python too, and does nothing again.
    again = skyproof(*call)
    assert again.code == 0
    assert "] " not in again.out
    page = (out / "report.html").stat().st_mtime_ns
    assert sp.assess(mine, out, vehicle_classes=["car"], device="cpu") == out / "report.html"
    assert (out / "report.html").stat().st_mtime_ns == page
    skyproof(*call, "--detector-gsd", 0.2).refused("holds a run with other settings")
    model = onnx.load(mine)
    model.producer_name = "another"
    onnx.save(model, mine)
    skyproof(*call).refused("read other content of", "best.onnx", "choose another --out")
    with pytest.raises(RunFolderError, match="read other content of"):
        sp.assess(str(mine), out, vehicle_classes=["car"], device="cpu")


def test_the_exported_network_finds_what_the_network_finds(file: Path, tmp_path: Path) -> None:
    theirs = BlackBoxDetector(OnnxFile(file, ["car"], None, 0.125), "x", vehicle_classes=["car"])
    image = torch.rand(1, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    ours = load_detector("retinanet").detect(image)[0]
    found = theirs.detect(image)[0]
    assert len(ours.scores) > 3
    torch.testing.assert_close(found.scores[:3], ours.scores[:3], rtol=0, atol=1e-4)
    torch.testing.assert_close(found.boxes[:3], ours.boxes[:3], rtol=0, atol=0.05)


def test_a_plan_and_mistakes_of_an_onnx_file(
    file: Path, tmp_path: Path, skyproof: Skyproof
) -> None:
    call = ["assess", file, "--out", tmp_path / "town", "--vehicle-classes"]
    plan = skyproof(*call, "car", "--plan")
    assert plan.code == 0
    assert "6 test scenes" in plan.out
    skyproof(*call, "boat").refused("--vehicle-classes expects some of car, shed; got boat")
    skyproof(*call, "car", "--detector-gsd", 50).refused("50 m per pixel is out of reason")
    text = tmp_path / "text.onnx"
    text.write_text("just a text")
    skyproof("assess", text, *call[2:], "car").refused("text.onnx is no detector in an ONNX file")
    assert not (tmp_path / "town").exists()
