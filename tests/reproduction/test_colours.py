"""The table of colours against numbers worked out by hand."""

import csv

import pytest

from skyproof.errors import RunFolderError
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.tables import main_part
from skyproof.results.results import Results
from tests.reproduction.fabricate import write_looks, write_scores

RATES = {"T-U-0": 0.8, "T-U-1": 1.0, "T-Fc-0": 0.2, "R-U-0": 0.1, "T-Pix-0": 0.5}
FACES = {"T-U-0": 0.6, "T-U-1": 0.8, "T-Fc-0": 0.1, "T-U_weather-0": 0.4, "R-U-0": 0.3}


@pytest.fixture
def folder(tmp_path):
    write_scores(tmp_path / "scores" / "000", RATES)
    return tmp_path


def read(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_shares_by_hand(folder):
    write_looks(folder / "looks", {**FACES, "R-U-1": 0.5})
    write_reproduction_report(folder)
    rows = {row["attack"]: row for row in read(folder / "tables" / "colours.csv")}
    # What was learnt in weather stands below what was learnt without.
    assert list(rows) == ["T-U", "T-U_weather", "T-Fc"]
    free = rows["T-U"]
    assert [free[key] for key in ("textures", "faces", "faces_min", "faces_max", "edges")] == [
        *("2", "70", "60", "80", "7")
    ]
    assert [free[key] for key in ("random_draws", "random_faces")] == ["2", "40"]
    # Its control is that of the texture; Fc has none here.
    assert rows["T-U_weather"]["random_faces"] == "40"
    assert (rows["T-Fc"]["random_draws"], rows["T-Fc"]["random_faces"]) == ("0", "–")
    bins = read(folder / "tables" / "colour_histograms.csv")
    assert [row["attack"] for row in bins[::3]] == ["T-U", "T-U_weather", "T-Fc", "R-U"]
    assert [bins[0][f"share_{value}"] for value in (0, 240)] == ["35", "35"]
    page = (folder / "tables" / "README.md").read_text()
    assert "Learnt in weather, T-U has 40.0 % at the faces, 70.0 % without." in page
    assert "| T-U | 2 | 70.0 (60.0 to 80.0) |" in page
    assert "colours.png" in page
    assert (folder / "tables" / "colours.svg").exists()


def test_a_run_that_measured_nothing_says_so(folder):
    write_reproduction_report(folder)
    assert not (folder / "tables" / "colours.csv").exists()
    assert not (folder / "tables" / "colours.png").exists()
    page = (folder / "tables" / "README.md").read_text()
    assert "colours were not measured in this run" in page


def test_tables_are_not_written_through_a_link(folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "README.md").write_text("precious")
    (folder / "tables").symlink_to(elsewhere)
    with pytest.raises(RunFolderError, match="tables is a link to a folder elsewhere"):
        write_reproduction_report(folder)
    assert [path.read_text() for path in elsewhere.iterdir()] == ["precious"]


def test_looks_judge_nothing(folder):
    before = main_part(Reproduction(Results.open(folder))).tables[0].rows
    write_looks(folder / "looks", FACES)
    results = Results.open(folder)
    assert results.detectors == ["retinanet", "yolov5"]
    assert main_part(Reproduction(results)).tables[0].rows == before
