"""`skyproof clear` and `skyproof adjust --drop`: from the command line, and what they refuse."""

import json
import sys

import pytest

from skyproof.scenes.backgrounds import BackgroundSet
from tests.cli.conftest import Skyproof
from tests.imagery.test_clear import tiled


def test_a_folder_is_cleared_and_tiles_are_dropped(tmp_path, skyproof: Skyproof):
    pytest.importorskip("cv2")
    folder = tiled(tmp_path / "tiled", labelled="acde")
    answer = skyproof("clear", folder, "--out", tmp_path / "cleared", "--method", "telea")
    assert answer.code == 0
    assert "5 of 5 kept" in answer.out
    assert "Not checked by a detector" in answer.out
    record = json.loads((tmp_path / "cleared" / "clearing.json").read_text())
    assert record["inpainting"]["name"] == "opencv telea"
    assert record["inpainting"]["opencv"]
    image = BackgroundSet.open(tmp_path / "cleared").pixels("c").int()
    assert (image[0] - image[1]).max() < 30
    assert skyproof("adjust", tmp_path / "cleared", "--drop", "c").code == 0
    assert BackgroundSet.open(tmp_path / "cleared").tiles("validation") == []


def test_what_cannot_work_is_one_sentence(tmp_path, skyproof: Skyproof, monkeypatch):
    folder, out = tiled(tmp_path / "tiled"), tmp_path / "cleared"
    (tmp_path / "plain").mkdir()
    (tmp_path / "network.onnx").write_text("no network")

    def refused(*words, text):
        skyproof("clear", *words).refused(text)
        assert not out.exists()
        assert not (tmp_path / ".cleared.partial").exists()

    refused(tmp_path / "plain", "--out", out, "--method", "telea", text="index.json is missing")
    refused(
        folder,
        "--out",
        out,
        "--inpainting",
        tmp_path / "network.onnx",
        text="network.onnx is no ONNX model",
    )
    refused(
        folder, "--out", out, "--inpainting", tmp_path / "none.onnx", text="none.onnx is missing"
    )
    refused(folder, "--out", out, "--detector", tmp_path / "plain", text="detector.json is missing")
    refused(
        folder,
        "--out",
        out,
        "--settings.largest-masked-share",
        "2",
        text="largest-masked-share expects",
    )
    monkeypatch.setitem(sys.modules, "cv2", None)
    refused(folder, "--out", out, text="extra 'imagery'")
    monkeypatch.undo()
    pytest.importorskip("cv2")
    refused(folder, "--out", out, text="no detector was given")
    out.mkdir()
    skyproof("clear", folder, "--out", out).refused("exists already")
