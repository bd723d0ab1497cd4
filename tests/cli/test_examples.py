"""The examples run on a demo's folder, are short, and are what the README shows."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
RESULTS = {"constraint_combination": "T-PixFcMa", "shape_attack": "S-O@0.2", "own_detector": "T-U"}


def code(example: Path) -> str:
    """Without the docstring."""
    return example.read_text(encoding="utf-8").partition('"""\n')[2].strip()


def test_every_example_is_known():
    assert {example.stem for example in EXAMPLES} == set(RESULTS)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_after_the_demo(example: Path, finished: Path, tmp_path: Path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(finished)
    short = code(example).replace("steps=200", "steps=2, batch_size=2").replace("steps=100", "steps=2, batch_size=2")
    assert short != code(example)
    done = subprocess.run(
        [sys.executable, "-c", short],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs/mine" / RESULTS[example.stem] / "camouflage.json").exists()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_stands_in_the_readme(example: Path):
    lines = [line for line in code(example).splitlines() if line.strip()]
    assert len(lines) < 15
    assert code(example) in (ROOT / "README.md").read_text(encoding="utf-8")
