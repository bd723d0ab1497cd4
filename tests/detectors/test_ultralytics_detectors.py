"""YOLOv5 through Ultralytics: what its import may do, and what is said when it is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import skyproof
from skyproof.detectors.ultralytics_detectors import YoloV5Detector
from skyproof.errors import ConfigurationError


def test_missing_extra_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "ultralytics"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(ConfigurationError, match=r"skyproof\[yolo\]"):
        YoloV5Detector("slim")


@pytest.mark.yolo
def test_import_leaves_home_environment_and_torch_alone(tmp_path: Path) -> None:
    # Not importorskip: importing it here would patch Pillow for every later test.
    if find_spec("ultralytics") is None:
        pytest.skip("ultralytics is not installed")
    program = """
import os, socket, torch
from PIL import Image
def refuse(*arguments, **named): raise AssertionError("network")
socket.socket.connect = socket.getaddrinfo = refuse
before, save, image_open = dict(os.environ), torch.save, Image.open
from skyproof.detectors.ultralytics_detectors import YoloV5Detector
detector = YoloV5Detector("slim")
assert dict(os.environ) == before and torch.save is save and Image.open is image_open
from ultralytics.utils import SETTINGS
assert SETTINGS["sync"] is False, SETTINGS
print(sum(parameter.numel() for parameter in detector.parameters()))
"""
    source = str(Path(skyproof.__file__).parents[1])
    environment = os.environ | {
        "HOME": str(tmp_path),
        "XDG_CONFIG_HOME": str(tmp_path / "config"),
        "PYTHONPATH": source,
    }
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["2508659"]
    assert result.stderr == ""
    assert list(tmp_path.iterdir()) == []
