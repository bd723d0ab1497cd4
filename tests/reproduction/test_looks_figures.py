"""Figures of what was tested: made from what a run keeps, left out where it lacks it."""

import numpy as np
from PIL import Image

from skyproof.reproduction.looks import looks_part
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.results import Results
from tests.reproduction.fabricate import write_looks, write_scores

RATES = {"T-U-0": 0.8, "T-Pix-0": 0.6, "T-Fc-0": 0.4, "S-O@0.4-0": 0.3}


def save(path, height, width):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def test_a_figure_of_everything_that_a_run_keeps(tmp_path):
    scores = tmp_path / "scores"
    write_scores(scores / "000", RATES)
    told = [{"label": "ground", "file": "samples/0.png"}]
    write_looks(tmp_path / "looks", {}, samples=told, sensor=told)
    save(tmp_path / "looks/samples/0.png", 20, 60)
    for name in RATES:
        save(scores / "000/patterns" / name / "on_vehicle.png", 80, 40)
        kind = "displacement" if "S-O" in name else "texture"
        save(tmp_path / "camouflages" / name / f"{kind}.png", 64, 64)
    write_reproduction_report(tmp_path)
    page = (tmp_path / "tables/README.md").read_text()
    for figure in ("classes", "samples", "sensor", "maps", "displacement"):
        assert (tmp_path / "tables" / f"{figure}.svg").exists()
        assert f"({figure}.png)" in page
    svg = (tmp_path / "tables/classes.svg").read_bytes()
    write_reproduction_report(tmp_path)
    assert (tmp_path / "tables/classes.svg").read_bytes() == svg


def test_what_an_older_run_lacks_is_left_out(tmp_path):
    write_scores(tmp_path / "scores" / "000", RATES)
    _, *figures = looks_part(Reproduction(Results.open(tmp_path))).blocks
    assert {figure.name for figure in figures if figure.files} == {"classes"}
    write_reproduction_report(tmp_path)
    assert "samples.png" not in (tmp_path / "tables/README.md").read_text()
