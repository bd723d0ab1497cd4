"""The tables of a reproduction against cells worked out by hand."""

import csv
import json
import math
import re
import shutil
from dataclasses import replace

import pytest
from scipy import stats

from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.reproduction.agreement import comparison
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.results import Results
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import Baseline
from skyproof.results.statistics.intervals import Interval
from tests.reproduction.fabricate import write_attack, write_scores
from tests.results.test_operating_points import ground


@pytest.fixture
def folder(tmp_path):
    return make_folder(tmp_path)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The same folder with its report; not to be changed."""
    folder = make_folder(tmp_path_factory.mktemp("written"))
    write_reproduction(folder)
    return folder


@pytest.fixture(scope="module")
def on_cycles(written, tmp_path_factory):
    """The written folder with scores on Cycles, written again; not to be changed."""
    folder = shutil.copytree(written, tmp_path_factory.mktemp("cycles") / "run")
    add_cycles(folder)
    write_reproduction(folder)
    return folder


def make_folder(folder):
    """20 tiles of 10 vehicles, all found before; the same share is lost on every tile."""
    write_scores(
        folder / "scores" / "000",
        {
            "T-U-0": 0.8,
            "T-U-1": 1.0,
            "R-U-0": 0.1,
            "R-U-1": 0.3,
            "T-Fc-0": 0.2,
            "T-Fc-1": 0.4,
            "R-Fc-0": 0.1,
        }
        | {"T-U_step1-0": 0.1, "T-U_step10-0": 0.9, "T-Fc_step1-0": 0.1, "T-Fc_relaxed-0": 0.5},
    )
    write_scores(
        folder / "scores" / "001",
        {
            "S-O@0.2-0": 0.4,
            "S-O@0.2-1": 0.4,
            "S-O@0.4-0": 0.9,
            "S-O@0.4-1": 0.7,
            "S-O@1-0": 1.0,
            "R-S-O@0.4-0": 0.1,
        }
        | {"S-O@0.2_step1-0": 1.0}
        | {
            "C-Fc-seq@0.2-0": 0.8,
            "C-Fc-seq@0.2-1": 0.8,
            "R-C-Fc@0.2-0": 0.2,
            "T-U_on_yolov5-0": 0.6,
        },
    )
    for name in ("T-U-0", "T-U-1", "T-Fc-0", "S-O@0.4-0"):
        write_attack(folder, name)
    write_attack(folder, "T-U_on_yolov5-0", detectors=("yolov5",), fell=3, change=0.05)
    signs = {"production_cost": -1, "installation_difficulty": -1, "operation_difficulty": -1}
    measured = {
        "name": "T-U-0",
        "score": {"texture": signs, "shape": dict.fromkeys(signs, 0), "total": -3},
        "texture": {"painted_area_m2": 17.5, "colours": 1000.0},
        "shape": None,
    }
    write_json(folder / "looks" / "practicality.json", {"rows": [measured]})
    return folder


def write_reproduction(folder):
    """Writes the report, and returns the page of tables."""
    write_reproduction_report(folder)
    return folder / "tables" / "README.md"


def table(folder, name):
    with open(folder / "tables" / f"{name}.csv", newline="", encoding="utf-8") as file:
        return {
            row["attack"] if "attack" in row else row["set"]: row for row in csv.DictReader(file)
        }


def close(text, expected):
    assert float(text) == pytest.approx(expected, abs=1e-4)


def test_textures(written):
    rows = table(written, "textures")
    assert list(rows) == ["T-U", "T-Fc", "R-U", "R-Fc"]
    row = rows["T-U"]
    close(row["easr"], 90)  # of 80 and 100
    close(row["easr_repeat_min"], 80)
    close(row["easr_repeat_max"], 100)
    close(row["random_easr"], 20)  # of 10 and 30
    close(row["net_easr"], 70)
    close(row["apd"], 45)  # 0.9 - (0.9 - 0.5 * 0.9)
    assert (row["repeats"], row["practicality"], row["paper_easr"], row["paper_apd"]) == (
        "2",
        "-3",
        "95.77",
        "50.97",
    )
    assert float(row["easr_low"]) < 90 < float(row["easr_high"])
    # A control has no control; what was not measured has no sum of signs.
    assert (rows["R-U"]["net_easr"], rows["T-Fc"]["practicality"]) == ("–", "–")


def test_damaged_practicality_is_one_sentence(tmp_path):
    folder = make_folder(tmp_path)
    (folder / "looks" / "practicality.json").write_text('{"rows": [{"name": "T-U"}]}')
    with pytest.raises(StoredFileError, match=r"practicality.json.*the field score is missing"):
        write_reproduction(folder)


def test_shapes_at_their_best_magnitude(written):
    rows = table(written, "shape_combined")
    assert list(rows) == ["S-O", "C-Fc-seq"]
    # S-O: P1 = 2 E Pr / (E + Pr): 0.4 and 0.8 give 0.533, 0.8 and 0.6 give 0.686, 1 and 0 give 0.
    alone = rows["S-O"]
    close(alone["pm_star"], 0.4)
    close(alone["pm_star_share"], 100)  # the tiles are all alike
    close(alone["p1_star"], 2 * 0.8 * 0.6 / 1.4)
    close(alone["easr"], 80)
    close(alone["net_easr"], 70)
    close(alone["easr_at_paper_pm_star"], 80)
    # The texture alone: 0.3 and 1 give 0.46; at 0.2: 0.8 and 0.8 give 0.8.
    combined = rows["C-Fc-seq"]
    close(combined["pm_star"], 0.2)
    close(combined["p1_star"], 0.8)
    close(combined["net_easr"], 60)
    assert (combined["paper_pm_star"], combined["paper_easr"]) == ("0.2", "86.8")
    with open(written / "tables" / "curves.csv", newline="", encoding="utf-8") as file:
        points = [
            (row["attack"], float(row["pm"]), float(row["easr"])) for row in csv.DictReader(file)
        ]
    assert points == [
        ("S-O", 0, 0),
        ("S-O", 0.2, 40),
        ("S-O", 0.4, 80),
        ("S-O", 1, 100),
        ("C-Fc-seq", 0, 30),
        ("C-Fc-seq", 0.2, 80),
    ]


def test_signs(written):
    page = (written / "tables" / "README.md").read_text()
    assert "in 8 of 9 pairs" in page  # 4 attacks on two detectors, one on one
    assert "| T-U_on_yolov5-0 | yolov5 | 8 | 3 | 0.125 | +0.0500 |" in page


def test_an_attack_that_still_gets_stronger_is_named(folder):
    write_attack(folder, "T-U-1", added=0.05)
    page = write_reproduction(folder).read_text()
    found = table(folder, "convergence")
    assert {name: row["converged"] for name, row in found.items()} == {
        "S-O@0.4-0": "yes",
        "T-Fc-0": "yes",
        "T-U-0": "yes",
        "T-U-1": "no",
        "T-U_on_yolov5-0": "yes",
    }
    close(found["T-U-1"]["added"], 5)
    assert "In 4 of 5 attacks the second half of the steps hid at most 2 points more" in page
    assert "| T-U-1 | 30 | 40.0 | 60 | 45.0 |" in page
    # Of two starts, the one that hid more on its own scenes is the best.
    close(table(folder, "textures")["T-U"]["best_repeat_easr"], 100)
    report = (folder / "report.html").read_text()
    assert "T-U: the second half of the steps still added over 2 points" in report


def test_attacks_by_the_papers_method_are_named(folder):
    page = write_reproduction(folder).read_text()
    assert "Method of the attacks: skyproof." in page
    assert "by the paper’s method" not in (folder / "report.html").read_text()
    write_attack(folder, "T-U-1", method="paper")
    page = write_reproduction(folder).read_text()
    assert "Method of the attacks: paper, skyproof." in page
    assert "<li>T-U: optimised by the paper’s method" in (folder / "report.html").read_text()


def test_rates_by_overlap_and_false_alarms(folder):
    nothing = Interval(math.nan, math.nan, math.nan)
    empty = Baseline(
        detector="yolov5",
        dataset="ground without vehicles",
        images=10,
        vehicles=0,
        real=False,
        ap_centre_1m=nothing,
        clustered_by="images",
        clusters=10,
        ap_iou_50=math.nan,
        precision=nothing,
        recall=nothing,
        threshold=0.5,
        false_alarms_per_km2=17.4,
        area_km2=0.05,
        alarm_scores=(0.6,),
    )
    write_scores(
        folder / "scores" / "002",
        {"T-Ma-0": 0.5, "R-Ma-0": 0.0},
        by_overlap={"T-Ma-0": 0.7, "R-Ma-0": 0.0},
        leniently={"T-Ma-0": 0.3, "R-Ma-0": 0.0},
        checks=[empty],
    )
    page = write_reproduction(folder).read_text()
    found = table(folder, "criteria")
    # Neither controls nor rungs, nor attacks on some detectors.
    assert set(found) == {"T-U", "T-Fc", "T-Ma", "S-O@0.2", "S-O@0.4", "S-O@1", "C-Fc-seq@0.2"}
    close(found["T-Ma"]["easr"], 50)
    close(found["T-Ma"]["easr_iou_50"], 70)
    close(found["T-Ma"]["easr_centre_in_box"], 30)
    close(found["T-Ma"]["ap_iou_50_original"], 90)
    close(found["T-Ma"]["ap_iou_50_adversarial"], 55)
    close(found["T-Ma"]["false_alarms_per_km2_original"], 1)
    close(found["T-Ma"]["false_alarms_per_km2_adversarial"], 2)
    assert "threshold of YOLOv5, 0.50, stands at 17 false alarms per km² of empty ground." in page
    assert "17 false alarms per km²" in (folder / "report.html").read_text()


def test_the_tables_have_rates_at_equal_false_alarms(folder):
    # Found vehicles have a score of 0.9; five alarms are allowed on 0.05 km².
    scores = [0.97, 0.96, 0.95, 0.94, 0.93]
    checks = [
        ground(0.05, [*scores, 0.6], detector="retinanet"),
        ground(0.05, [*scores, 0.91], detector="yolov5"),
    ]
    write_scores(folder / "scores" / "002", {"R-U_best": 0.25}, checks=checks)
    page = write_reproduction(folder).read_text()
    row = table(folder, "textures")["T-U"]
    # YOLOv5 finds nothing at its threshold, so the mean is undefined.
    assert row["easr_at_100_per_km2"] == "–"
    with open(folder / "tables" / "transfer.csv", newline="", encoding="utf-8") as file:
        rows = [one for one in csv.DictReader(file) if one["operating_point"] == "100_per_km2"]
    assert rows
    assert all(one["yolov5"] == "–" != one["retinanet"] for one in rows)
    checks[1] = replace(checks[1], alarm_scores=(*scores, 0.5))
    write_rows(folder / "scores" / "002" / "baselines.json", checks)
    page = write_reproduction(folder).read_text()
    for name in ("textures", "criteria"):
        row = table(folder, name)["T-U"]
        close(row["easr_at_100_per_km2"], float(row["easr"]))
        assert "easr_at_10_per_km2" not in row
    row = table(folder, "textures")["T-U"]
    # Of the draws, one hides 30 %.
    close(row["net_strongest_control_easr_at_100_per_km2"], float(row["easr"]) - 30)
    assert row["found_before_at_100_per_km2"] == row["found_before"] == "100"
    assert "| EASR at 100/km² | net of best control at 100/km² |" in page


def test_transfer(written):
    with open(written / "tables" / "transfer.csv", newline="", encoding="utf-8") as file:
        rows = [
            (row["attacked_on"], row["retinanet"], row["yolov5"]) for row in csv.DictReader(file)
        ]
    assert rows == [("yolov5", "60", "60"), ("retinanet yolov5", "90", "90")]


def test_order_beside_the_papers(written):
    assert comparison(Reproduction(Results.open(written))) == pytest.approx(
        {"T-U": 90, "T-Fc": 30, "R-U": 20, "R-Fc": 10, "S-O": 80, "C-Fc-seq": 80}
    )
    page = (written / "tables" / "README.md").read_text()
    with open(written / "tables" / "agreement.csv", newline="", encoding="utf-8") as file:
        rows = {(row["compared"], row["set"]): row for row in csv.DictReader(file)}
    ours, all_of_them = (
        "our EASR and the paper’s on its renderer",
        "textures, shape and combinations",
    )
    assert (ours, "textures") not in rows  # two are too few
    # T-U 90, S-O 80, C-Fc-seq 80, T-Fc 30 against 95.77, 89.82, 86.80, 37.22: ranks 4 2.5 2.5 1 and
    # 4 3 2 1.
    row = rows[ours, all_of_them]
    assert row["attacks"] == "4"
    close(row["spearman"], 4.5 / (4.5 * 5) ** 0.5)
    # Against Blender's 70.02, 78.86, 70.37, 55.96: ranks 2 4 3 1.
    close(rows["our EASR and the paper’s on Blender", all_of_them]["spearman"], 1.5 / 22.5**0.5)
    # What the paper's two columns agree is the same in every run.
    itself = rows["the paper’s two columns", "textures"]
    assert (itself["attacks"], itself["spearman_low"]) == ("12", "–")
    renderer, blender = (
        [getattr(PAPER_RESULTS[name], column) for name in PAPER_RESULTS if name.startswith("T-")]
        for column in ("easr", "easr_blender")
    )
    close(itself["spearman"], stats.spearmanr(renderer, blender).statistic)
    assert "| the paper’s two columns | textures | 12 | 0.65 |" in page


def add_cycles(folder):
    """8 of 10 vehicles found before; shares of eighths are lost, on every tile alike."""
    rates = {
        "T-U-0": 0.5,
        "T-U-1": 0.75,
        "R-U-0": 0.125,
        "R-U-1": 0.375,
        "T-Fc-0": 0.5,
        "R-Fc-0": 0.25,
    }
    rates |= {"T-Fc-1": 0.5, "S-O@0.4-0": 0.5, "S-O@0.4-1": 0.25, "R-S-O@0.4-0": 0.25}
    write_scores(folder / "scores" / "cycles", rates, found=0.8, renderer="cycles")


def test_cycles_beside_the_renderer(written, on_cycles):
    before = {name: table(written, name) for name in ("textures", "shape_combined", "agreement")}
    page = (written / "tables" / "README.md").read_text()
    assert "Cycles" not in page
    assert not (written / "tables" / "cycles.csv").exists()
    results = json.loads((written / "results.json").read_text())["rows"]
    # What was there stays, to the last digit.
    both = json.loads((on_cycles / "results.json").read_text())["rows"]
    assert [row for row in both if row["renderer"] == "torch"] == results
    assert {row["renderer"] for row in both[len(results) :]} == {"cycles"}
    for name, rows in before.items():
        after = table(on_cycles, name)
        assert {
            attack: {key: after[attack][key] for key in row} for attack, row in rows.items()
        } == rows, name

    row = table(on_cycles, "textures")["T-U"]
    close(row["cycles_easr"], 62.5)  # of 50 and 75
    close(row["cycles_random_easr"], 25)  # of 12.5 and 37.5
    close(row["cycles_net_easr"], 37.5)
    close(row["cycles_change"], 62.5 - 90)
    close(row["cycles_apd"], 50 * 0.625)
    assert (row["paper_easr_blender"], row["paper_apd_blender"]) == ("70.02", "63.17")
    control = table(on_cycles, "textures")["R-U"]
    close(control["cycles_easr"], 25)
    assert (control["cycles_net_easr"], control["paper_easr_blender"]) == ("–", "16.31")
    # At the PM* of the renderer; what was not scored on Cycles is a dash.
    alone = table(on_cycles, "shape_combined")["S-O"]
    close(alone["pm_star"], 0.4)
    close(alone["cycles_easr"], 37.5)
    close(alone["cycles_net_easr"], 12.5)
    combined = table(on_cycles, "shape_combined")["C-Fc-seq"]
    assert (combined["cycles_easr"], combined["cycles_change"], combined["paper_easr_blender"]) == (
        "–",
        "–",
        "70.37",
    )


def test_how_far_success_moves_to_cycles(folder):
    add_cycles(folder)
    # What was chosen is no random draw.
    chosen = {"R-U_plain": 1.0, "R-S-O@0.4_plain": 1.0}
    write_scores(folder / "scores" / "chosen", chosen, found=0.8, renderer="cycles")
    write_reproduction(folder)
    with open(folder / "tables" / "cycles.csv", newline="", encoding="utf-8") as file:
        rows = {row["kind"]: row for row in csv.DictReader(file)}
    assert list(rows) == [
        "textures",
        "shapes",
        "all attacks",
        "random textures",
        "random shapes and combinations",
    ]
    # T-U 80, 100 and T-Fc 20, 40 on the renderer; 50, 75 and 50, 50 on Cycles.
    close(rows["textures"]["easr"], 60)
    close(rows["textures"]["cycles_easr"], 56.25)
    close(rows["textures"]["change"], -3.75)
    # Tiles that all agree leave the exact margin, 1 - 0.025^(1/20), of both renderers' means. The
    # repeats add what a single one would: (1.96 · 4.6)² for T-U (-30, -25), 1.96² · 2 · 10² for
    # T-Fc (30, 10), each halved before it is squared.
    margin = (2 * (100 * (1 - 0.025**0.05)) ** 2 + 1.959964**2 * (4.6**2 + 200) / 4) ** 0.5
    close(rows["textures"]["change_low"], -3.75 - margin)
    # 10, 30 and 10 became 12.5, 37.5 and 25; R-U counts as much as R-Fc, which has one draw.
    close(rows["random textures"]["change"], 25 - 15)
    assert (rows["random textures"]["camouflages"], rows["random textures"]["paper_number"]) == (
        "2",
        "4",
    )
    close(rows["random textures"]["paper_easr_blender"], (16.31 + 18.95 + 18.95 + 20.24) / 4)
    assert rows["random shapes and combinations"]["camouflages"] == "1"
    close(rows["shapes"]["change"], 37.5 - 80)  # S-O@0.2 and S-O@1 were not scored on Cycles


@pytest.mark.slow
def test_one_repeat_of_two_on_cycles(folder):
    write_scores(
        folder / "scores" / "cycles",
        {"T-U-1": 0.5, "R-U-0": 0.25},
        found=0.8,
        renderer="cycles",
    )
    page = write_reproduction(folder).read_text()
    row = table(folder, "textures")["T-U"]
    close(row["easr"], 90)
    close(row["cycles_easr"], 50)
    close(row["cycles_change"], 50 - 100)  # of the second repeat alone
    assert "Of 2 repeats of an attack or draws of a control, Cycles has 1;" in page
    texture = next(line for line in page.splitlines() if line.startswith("| T-U |"))
    assert re.search(r"\| 50\.0 \([^)]*\)‡ \| 25\.0 \([^)]*\)‡ \| – \|", texture)
    assert "‡ Cycles has one repeat or draw alone" in page
    # Explained, too, where of another attack Cycles has as many as the renderer.
    rates = {"T-Fc-0": 0.5, "T-Fc-1": 0.5}
    write_scores(folder / "scores" / "more", rates, found=0.8, renderer="cycles")
    page = write_reproduction(folder).read_text()
    assert "repeats of an attack or draws of a control, Cycles has" not in page
    assert "‡ Cycles has one repeat or draw alone" in page


def test_orders_on_cycles(on_cycles):
    with open(on_cycles / "tables" / "cycles_agreement.csv", newline="", encoding="utf-8") as file:
        rows = {(row["compared"].split()[-1], row["set"]): row for row in csv.DictReader(file)}
    # T-U 62.5, T-Fc 50, S-O 37.5 against Blender's 70.02, 55.96, 78.86: ranks 3 2 1 and 2 1 3.
    ours = rows["Blender", "textures, shape and combinations"]
    assert ours["attacks"] == "3"
    close(ours["spearman"], -0.5)
    # T-U 90, T-Fc 30, S-O@0.4 80 on the renderer: ranks 3 1 2.
    own = rows["renderer", "all attacks, at every magnitude"]
    assert own["attacks"] == "3"
    close(own["spearman"], 0.5)


def test_the_page_says_what_the_cycles_column_is(on_cycles):
    page = (on_cycles / "tables" / "README.md").read_text()
    texture = next(line for line in page.splitlines() if line.startswith("| T-U |"))
    assert "| 62.5 (" in texture
    assert "| 37.5 (" in texture
    assert "| 95.77 | 70.02 | 50.97 |" in texture
    header = next(
        line for line in page.splitlines() if line.startswith("| attack | practicality |")
    )
    assert header.count("|") == texture.count("|")
    assert "‡" not in page
    assert "## On Cycles" in page
    assert "Blender’s path tracer Cycles" in page
    # Rows without copies and transfer: 4 of textures, S-O at three PM and a control, C-Fc-seq and
    # its; 6 are there.
    assert "Not scored on Cycles yet: 4 of 10 attacks and controls." in page
    assert "repeats of an attack or draws" not in page  # as many on both
    # T-U 37.5, T-Fc 25 and S-O 12.5 above chance; two draws of R-U leave it open by more than 100,
    # tiles (17 of either) and two seeds of T-Fc by 28.
    assert "in 0 of 3 rows" in page
    assert "better than chance there: T-U, T-Fc, S-O." in page
    assert "a single draw there, which says nothing about others: T-Fc, S-O." in page
    # AP 0.9 for both; 10 and 8 of 10 vehicles found.
    assert "| RetinaNet | 90.0 | 90.0 | 100.0 | 80.0 |" in page


def test_undefined_success_is_a_dash(tmp_path):
    write_scores(
        tmp_path / "scores" / "000",
        {"T-U-0": 0.0, "T-Fc-0": 0.0, "R-U-0": 0.0, "S-O@0.4-0": 0.0},
        found=0.0,
    )
    write_reproduction(tmp_path)
    assert table(tmp_path, "textures")["T-U"]["easr"] == "–"
    assert "| T-U | – | – |" in (tmp_path / "tables" / "README.md").read_text()


def test_synthetic_data_alone_is_said_first(written):
    lines = (written / "tables" / "README.md").read_text().split("\n\n")
    assert lines[1] == "**Worth attacking?** RetinaNet: no precheck. YOLOv5: no precheck."
    assert lines[2].startswith(
        "**Synthetic data only.** Ground and vehicles are computer-generated"
    )
    assert (
        "(AP with centres within 1 m: RetinaNet 90.0 %, YOLOv5 90.0 %), not on real ones"
        in lines[2]
    )


def test_files_and_the_same_bytes_again(written, tmp_path):
    folder = shutil.copytree(written, tmp_path / "run")
    names = {"README.md", "textures.md", "shape_combined.md", "easr_vs_pr.svg", "easr_vs_pr.png"}
    names |= {"classes.svg", "classes.png"}
    names |= {
        f"{name}.csv"
        for name in (
            "textures",
            "shape_combined",
            "curves",
            "agreement",
            "criteria",
            "practicality",
        )
    }
    names |= {f"{name}.csv" for name in ("transfer", "convergence", "signs")}
    first = {path.name: path.read_bytes() for path in (folder / "tables").iterdir()}
    assert set(first) == names
    write_reproduction(folder)
    assert {path.name: path.read_bytes() for path in (folder / "tables").iterdir()} == first
    assert json.loads((folder / "results.json").read_text())["rows"]


def test_nothing_scored_yet(tmp_path):
    with pytest.raises(StoredFileError, match="no scores"):
        write_reproduction(tmp_path)


def test_what_is_tested_counts_each_camouflage_once(folder):
    # At PM 0.2 the shape hides no more than the texture alone, which so stands for both.
    write_scores(folder / "scores" / "002", {"C-U-seq@0.2-0": 0.5, "R-C-U@0.2-0": 0.1})
    page = write_reproduction(folder).read_text()
    tests = next(part for part in page.split("\n\n") if part.startswith("Placebo:"))
    assert table(folder, "shape_combined")["C-U-seq"]["pm_star"] == "0"
    # T-U, T-Fc, S-O@0.4 and C-Fc-seq@0.2; one draw each but for T-U.
    assert "for 3 of 4 distinct camouflages above" in tests
    assert "Not surely more than an average random draw: T-Fc." in tests
    assert "without optimisation" not in tests
    assert "a single draw, which says nothing about others: T-Fc, S-O@0.4, C-Fc-seq@0.2." in tests
    assert "for every repeat and every draw, for 4 of 4." in tests
    assert "(McNemar’s exact test, corrected alike): 4 of 4." in tests
    row = table(folder, "textures")["T-U"]
    # All 20 tiles lose more to T-U: twice 2^-20, times rows.
    assert float(row["control_p_holm"]) < 1e-4
    assert float(row["no_camouflage_p_holm"]) < 1e-4


def test_what_was_chosen_and_not_learnt_stands_in_the_tables(folder):
    write_scores(
        folder / "scores" / "002",
        {"R-U_plain": 0.2, "R-U_best": 0.8, "R-C-Fc-seq@0.2-0": 0.2},
    )
    page = write_reproduction(folder).read_text()
    row = table(folder, "textures")["T-U"]
    assert row["strongest_control"] == "R-U_best"
    close(row["strongest_control_easr"], 80)
    close(row["net_strongest_control_easr"], 10)
    assert float(row["net_strongest_control_easr_low"]) < 0
    tests = next(part for part in page.split("\n\n") if part.startswith("Placebo:"))
    # A plain paint all over is a control of T-Fc, too.
    assert "Of 2, 0 surely hide more than every control found without optimisation." in tests
    assert "Not surely due to learning: T-U, T-Fc." in tests
    shapes = table(folder, "shape_combined")["C-Fc-seq"]
    close(shapes["drawn_shape_easr"], 20)
    close(shapes["net_drawn_shape_easr"], 60)
    assert "What a learnt shape adds to the texture under it:" in page


@pytest.mark.slow
def test_what_was_chosen_and_not_learnt_on_cycles(folder):
    add_cycles(folder)
    chosen = {"R-U_plain": 0.125, "R-U_best": 0.25, "R-S-O@0.4_plain": 0.5}
    write_scores(folder / "scores" / "chosen", chosen, found=0.8, renderer="cycles")
    page = write_reproduction(folder).read_text()
    row = table(folder, "textures")["T-U"]
    # One of two draws hides more than what was chosen.
    assert row["cycles_strongest_control"] == "R-U-1"
    close(row["cycles_strongest_control_easr"], 37.5)
    close(row["cycles_net_strongest_control_easr"], 62.5 - 37.5)
    # Two repeats that lie so far apart leave it open.
    assert float(row["cycles_net_strongest_control_easr_low"]) < 0
    # A learnt shape hides 37.5 % there, every vertex out 50 %.
    close(table(folder, "shape_combined")["S-O"]["cycles_net_strongest_control_easr"], -12.5)
    # A plain paint all over is a control of T-Fc, too; its one draw hides 25 of its 50 %.
    said = "Against the strongest control found without optimisation, 0 of 3 do."
    assert said in page
    # One that is stronger on the renderer and was not drawn on Cycles: nothing is said there.
    write_scores(folder / "scores" / "002", {"R-U_search": 0.7, "R-U_best": 0.2})
    write_reproduction(folder)
    row = table(folder, "textures")["T-U"]
    assert row["strongest_control"] == "R-U_search"
    assert (row["cycles_strongest_control"], row["cycles_net_strongest_control_easr"]) == ("–", "–")
    assert row["cycles_easr"] != "–"
