"""Headline attacks on several trainings of the detectors, against numbers worked out by hand."""

import csv

import pytest

from skyproof.errors import ConfigurationError
from skyproof.files import write_json
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.report import write_reproduction_report
from tests.reproduction.fabricate import DETECTORS, write_scores

RATES = {
    0: {"T-U-0": 0.8, "R-U-0": 0.1, "R-U-1": 0.3},
    1: {"T-U-0": 0.6, "R-U-0": 0.2, "R-U-1": 0.2},
    2: {"T-U-0": 1.0, "R-U-0": 0.0, "R-U-1": 0.1},
}
OTHERS = {"T-Fc-0": 0.4, "R-Fc-0": 0.1, "S-O@0.4-0": 0.3}


def write_cards(layout, weights):
    """What is recorded of the detectors; their weights differ in every training."""
    for name in DETECTORS:
        card = {
            "format": 1,
            "name": name,
            "size": "slim",
            "threshold": 0.5,
            "gsd_m": 0.125,
            "validation": {"ap_centre_1m": 0.9 + 0.01 * int(weights)},
        }
        card["weights_sha256"] = f"{name} {weights}"
        write_json(layout.detector(name) / "detector.json", card)


@pytest.fixture
def folder(tmp_path):
    """20 tiles of 10 vehicles, all found before; the same share is lost on every tile."""
    for number, rates in RATES.items():
        layout = PaperLayout(tmp_path).training(number)
        write_scores(layout.score("000"), {**rates, **(OTHERS if not number else {})})
        write_cards(layout, str(number))
    return tmp_path


def table(folder):
    write_reproduction_report(folder)
    with open(folder / "tables" / "trainings.csv", newline="", encoding="utf-8") as file:
        return {(row["attack"], row["detector"]): row for row in csv.DictReader(file)}


def close(text, expected):
    assert float(text) == pytest.approx(expected, abs=1e-4)


def test_by_hand(folder):
    rows = table(folder)
    # What was not learnt on every training has no row.
    assert [attack for attack, _ in rows] == ["T-U"] * 3
    row = rows["T-U", "mean"]
    assert (row["trainings"], row["seeds"], row["random_draws"]) == ("3", "1", "2")
    for number, easr, net in ((0, 80, 60), (1, 60, 40), (2, 100, 95)):
        close(row[f"easr_training_{number}"], easr)
        close(row[f"net_easr_training_{number}"], net)
    close(row["easr"], 80)
    close(row["easr_training_sd"], 20)
    close(row["random_easr"], 15)
    close(row["net_easr"], 65)
    # 20 tiles, of 40 vehicles, that agree on everything, and trainings 0, -20 and 20 points off.
    margin = 100 * (1 - 0.025 ** (1 / 20))
    close(row["easr_low"], 80 - (margin**2 + (4.302653 * 20) ** 2 / 3) ** 0.5)
    close(row["easr_high"], 100)


def test_seeds_are_a_part_of_how_trainings_differ(folder):
    for number, rate in {0: 1.0, 1: 0.8, 2: 0.8}.items():
        write_scores(PaperLayout(folder).training(number).score("001"), {"T-U-1": rate})
    # A seed that one training alone has does not count.
    write_scores(folder / "scores" / "002", {"T-U-2": 0.1})
    row = table(folder)["T-U", "mean"]
    assert row["seeds"] == "2"
    for number, easr in ((0, 90), (1, 70), (2, 90)):
        close(row[f"easr_training_{number}"], easr)
    mean = 250 / 3
    squares = sum((easr - mean) ** 2 for easr in (90, 70, 90))
    # Seeds are a part of that, and are not counted once more.
    error = (squares / 2 / 3) ** 0.5
    margin = 100 * (1 - 0.025 ** (1 / 20))
    close(row["easr_low"], mean - (margin**2 + (4.302653 * error) ** 2) ** 0.5)


def test_the_page_tells_of_the_trainings(folder):
    write_reproduction_report(folder)
    page = (folder / "tables" / "README.md").read_text()
    assert "## Other trainings of the detectors" in page
    assert "RetinaNet 90.0, 91.0, 92.0" in page
    lines = [line for line in page.splitlines() if line.startswith("| T-U | mean |")]
    assert [line.split(" | ")[2:5] for line in lines] == [
        ["80.0", "60.0", "100.0"],
        ["60.0", "40.0", "95.0"],
    ]
    said = (folder / "report.html").read_text()
    assert "do not cover another training of the detectors" in said


def test_a_run_with_one_training_says_nothing(folder):
    for number in (1, 2):
        place = PaperLayout(folder).training(number).score("000")
        # Trained, and being scored.
        place.rename(place.with_name(".000.partial"))
    write_reproduction_report(folder)
    assert not (folder / "tables" / "trainings.csv").exists()
    assert "Other trainings" not in (folder / "tables" / "README.md").read_text()
    assert "another training of the detectors" in (folder / "report.html").read_text()


def test_scores_of_other_vehicles_are_refused(folder):
    place = PaperLayout(folder).training(1).score("000")
    place.rename(folder / "kept")
    write_scores(place, RATES[1], tiles=19)
    with pytest.raises(ConfigurationError, match="Training 1 was not scored on the vehicles"):
        write_reproduction_report(folder)
    place.rename(folder / "kept-too")
    write_scores(place, RATES[1], detectors=("retinanet",))
    with pytest.raises(ConfigurationError, match="Training 1 was scored by retinanet, but"):
        write_reproduction_report(folder)
