"""After a kill or an interrupt in the middle of any stage the same command goes on.

The results are the same as without it.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import TINY, assert_same_results
from tests.tiny_suite import TINY_SUITE

HELPER = Path(__file__).with_name("killed.py")
ROOT = HELPER.parents[2]


def ended_at(folder: Path, moments: list[list[object]]) -> tuple[list[tuple[int, list[str]]], str]:
    done = subprocess.run(
        [sys.executable, str(HELPER), str(folder), json.dumps(moments), *TINY],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    return [(code, left) for code, left in map(json.loads, done.stdout.splitlines())], done.stderr


@pytest.mark.slow
def test_killed_and_interrupted_in_every_stage(tmp_path: Path, finished: Path) -> None:
    # How, where, which time; and the name that must not be there yet: the one that means
    # "finished".
    moments = [
        ("write", "config.json", 1, "config.json"),
        ("rename", "config.json", 1, "config.json"),
        ("write", "steps.json", 1, "backgrounds"),
        ("interrupt", ".backgrounds.partial/tiles", 1, "backgrounds"),
        ("write", "tiles/", 4, "backgrounds"),
        ("rename", "/backgrounds", 1, "backgrounds/tiles"),
        ("rename", "retinanet/weights.safetensors", 1, "detectors/retinanet/detector.json"),
        ("rename", "retinanet/detector.json", 1, "detectors/retinanet/detector.json"),
        ("write", "fleet.safetensors", 2, "fleets"),
        ("write", "scenes/test.jsonl", 1, "scenes/test.jsonl"),
        ("write", "datasets/test/images/", 5, "datasets/test"),
        ("appears", "camouflages/T-U/checkpoint.safetensors", 1, "camouflages/T-U/camouflage.json"),
        ("write", "T-U/previews/", 1, "camouflages/T-U/camouflage.json"),
        (
            "interrupt",
            "camouflages/T-U/previews/000001.png",
            1,
            "camouflages/T-U/camouflage.json",
        ),
        ("rename", "T-U/checkpoint.safetensors", 1, "camouflages/T-U/camouflage.json"),
        ("rename", "T-U/camouflage.json", 1, "camouflages/T-U/camouflage.json"),
        ("write", "R-U-0/texture.png", 1, "camouflages/R-U-0/camouflage.json"),
        ("appears", "scores/.test-0.partial", 1, "scores/test-0"),
        ("rename", "outcomes.parquet", 1, "scores/test-0"),
        ("write", "pairs/T-U/", 1, "scores/test-0"),
        ("rename", "on_vehicle.png", 1, "scores/test-0"),
        ("rename", "scores/test-0", 8, "scores/test-0"),
        ("write", "results.json", 1, "results.json"),
        ("write", "report.html", 1, "report.html"),
    ]
    folder = tmp_path / "run"
    ends, errors = ended_at(folder, [list(moment[:3]) for moment in moments])
    for moment, (code, left) in zip(moments, ends, strict=False):
        assert code == (130 if moment[0] == "interrupt" else -9), (moment, errors)
        assert moment[3] not in left, moment
        assert "report.html" not in left
    assert ends[-1][0] == 0, errors
    assert errors.splitlines() == ["skyproof: stopped; give the same command again to go on."] * 2
    assert_same_results(folder, finished)
    steps = [
        json.loads(line)
        for line in (folder / "camouflages/T-U/steps.jsonl").read_text().splitlines()
    ]
    assert [row["step"] for row in steps] == list(range(1, TINY_SUITE.steps.texture + 1))
