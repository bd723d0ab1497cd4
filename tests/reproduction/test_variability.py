"""Likeness of starts against numbers worked out by hand."""

import csv

import numpy as np
import pytest
from PIL import Image

from skyproof.reproduction.report import write_reproduction_report
from tests.reproduction.fabricate import write_looks, write_scores

# Whoever is hidden by a start that hides less is hidden by one that hides more.
RATES = {"T-U-0": 0.2, "T-U-1": 0.5, "T-Pix-0": 1.0, "T-Pix-1": 0.5, "T-Fc-0": 0.4, "R-U-0": 0.1}


def pair(first, second, correlation, distance):
    seen = {"seen_correlation": correlation, "seen_distance": distance / 2}
    told = {"first": first, "second": second, "correlation": correlation, "distance": distance}
    return told | seen


PAIRS = [
    pair("T-U-0", "T-U-1", 0.25, 60.0),
    pair("T-Pix-0", "T-Pix-1", None, 40.0),
    pair("R-U-0", "R-U-1", 0.0, 80.0),
]


@pytest.fixture
def folder(tmp_path):
    write_scores(tmp_path / "scores" / "000", RATES)
    return tmp_path


def read(path):
    with open(path, newline="", encoding="utf-8") as file:
        return {row["attack"]: row for row in csv.DictReader(file)}


def test_by_hand(folder):
    write_looks(folder / "looks", dict.fromkeys(RATES, 0.5), pairs=PAIRS)
    for name in ("T-U-0", "T-U-1"):
        (folder / "camouflages" / name).mkdir(parents=True)
        pixels = np.zeros((512, 512, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "camouflages" / name / "texture.png")
    write_reproduction_report(folder)
    rows = read(folder / "tables" / "variability.csv")
    assert list(rows) == ["T-U", "T-Pix"]
    free = rows["T-U"]
    assert [free[key] for key in ("starts", "correlation", "distance", "seen_distance")] == [
        *("2", "0.25", "60", "30")
    ]
    assert [free[key] for key in ("random_correlation", "random_distance")] == ["0", "80"]
    # 20 and 50 in 100 hidden, the ones among the others: 0.1 / sqrt(0.16 * 0.25).
    assert float(free["agreement"]) == pytest.approx(0.5, abs=1e-4)
    assert float(free["agreement_low"]) <= 0.5 <= float(free["agreement_high"])
    # One start hides all, so there is nothing to correlate.
    assert rows["T-Pix"]["agreement"] == "–"
    assert rows["T-Pix"]["correlation"] == "–"
    starts = read(folder / "tables" / "starts.csv")
    assert [float(row["easr"]) for row in starts.values()] == [20, 50, 100, 50]
    assert float(starts["T-U-1"]["easr_low"]) < 50 < float(starts["T-U-1"]["easr_high"])
    assert (folder / "tables" / "variability.png").exists()


def test_a_run_without_starts_says_so(folder):
    write_reproduction_report(folder)
    assert not (folder / "tables" / "variability.csv").exists()
    page = (folder / "tables" / "README.md").read_text()
    assert "How alike repeats of an attack are was not measured in this run" in page


def test_without_maps_there_is_no_figure_of_them(folder):
    write_looks(folder / "looks", dict.fromkeys(RATES, 0.5), pairs=PAIRS)
    write_reproduction_report(folder)
    page = (folder / "tables" / "README.md").read_text()
    assert "The starts of T-U one by one" in page
    assert not (folder / "tables" / "variability.png").exists()
    assert "variability.png" not in page
