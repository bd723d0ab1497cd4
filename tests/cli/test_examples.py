"""The examples run on a demo's folder and are short.

They are what the README or a page of the docs shows.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from skyproof.files import write_json

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# What an example leaves in runs/mine, and the page that shows it.
RESULTS = {
    "black_box": ("black_box/report.html", "docs/detectors.md"),
    "imported_checkpoint": ("T-U-on-vehicles/camouflage.json", "docs/detectors.md"),
    "detections_over_http": ("service/report.html", "docs/detectors.md"),
    "constraint_combination": ("T-PixFcMa/camouflage.json", "docs/attacks.md"),
    "own_detector": ("T-U/camouflage.json", "docs/attacks.md"),
    "maite_evaluate": ("hidden.json", "docs/maite.md"),
    "maite_sensor": ("", "docs/maite.md"),
    "shape_attack": ("S-O@0.2/camouflage.json", "README.md"),
}
NEEDS_A_SERVER = "detections_over_http"
"""It runs in `test_assess_black_box.py`."""

NEEDS_NRTK = "maite_sensor"
"""It leaves nothing, and runs where NRTK is installed."""

AS_IT_IS = {"black_box", "maite_evaluate", "maite_sensor"}
"""What needs no shortening."""

SHORTER = {
    "AttackSettings(steps=400)": "AttackSettings(steps=2, batch_size=2)",
    "AttackSettings(steps=200)": "AttackSettings(steps=2, batch_size=2)",
    'open("runs/images/train"), 200': 'open("runs/images/train"), 2',
}


def code(example: Path) -> str:
    """Without the docstring."""
    return example.read_text(encoding="utf-8").partition('"""\n')[2].strip()


def test_every_example_is_known():
    assert {example.stem for example in EXAMPLES} == set(RESULTS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "example",
    [example for example in EXAMPLES if example.stem != NEEDS_A_SERVER],
    ids=lambda path: path.stem,
)
def test_an_example_runs_after_the_demo(example: Path, finished: Path, tmp_path: Path):
    if example.stem == NEEDS_NRTK:
        pytest.importorskip("nrtk", reason="needs nrtk[pybsm,maite]")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(finished)
    # Images for training and validation.
    (tmp_path / "runs" / "images").symlink_to(finished / "datasets")
    short = code(example)
    for long, brief in SHORTER.items():
        short = short.replace(long, brief)
    assert (short == code(example)) == (example.stem in AS_IT_IS)
    done = subprocess.run(
        [sys.executable, "-c", short],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    if example.stem == NEEDS_NRTK:
        assert "easr_low" in done.stdout
    else:
        assert (tmp_path / "runs/mine" / RESULTS[example.stem][0]).exists()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_stands_in_the_docs(example: Path):
    page = RESULTS[example.stem][1]
    lines = [line for line in code(example).splitlines() if line.strip()]
    assert len(lines) < (15 if page == "README.md" else 30)
    assert code(example) in (ROOT / page).read_text(encoding="utf-8")


def test_the_walkthrough_runs_after_the_demo(
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    demo = tmp_path / "runs" / "demo"
    shutil.copytree(finished, demo)
    # The one vehicle of the tiny run's first scene has to be found.
    place = demo / "detectors/retinanet/detector.json"
    write_json(place, {**json.loads(place.read_text()), "threshold": 0.01})
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "walkthrough.md").read_text(encoding="utf-8")
    snippets = re.findall(r"^```python\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(snippets), "walkthrough.md", "exec"), {})
    said = capsys.readouterr().out
    # Each image is drawn as the demo stored it, and stands in its scores.
    assert "largest difference 0" in said
    assert f"vehicles; ours: ['{said.partition(' at ')[0].split()[-1]}'" in said
