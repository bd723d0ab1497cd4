"""What is hidden from held-out detectors, in tables, page and figure of a reproduction."""

import csv

import pytest

from skyproof.files import write_json
from skyproof.reproduction.held_out import detectors_and_mean, held_out_part, held_out_rows
from skyproof.reproduction.report import write_reproduction_report
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.results import Results
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import Baseline
from skyproof.results.statistics.intervals import Interval
from tests.reproduction.fabricate import DETECTORS, write_scores

RATES = {"T-U-0": 0.8, "T-Fc-0": 0.3, "R-U-0": 0.1, "R-Fc-0": 0.1, "S-O@0.4-0": 0.9}


def add_judges(folder, table, rates, *, ap=0.6, trained_on="train: tiles of real imagery (a.png)"):
    """Two judges that find half of the vehicles, on the renderer and on Cycles."""
    own = folder / "judges" / table
    for renderer, name in (("torch", "rendered test"), ("cycles", "Blender Cycles test")):
        scores = own / "scores" / ("000" if renderer == "torch" else "cycles-000")
        write_scores(scores, rates, found=0.5, renderer=renderer)
        sure = Interval(ap, ap - 0.1, ap + 0.1)
        write_rows(
            scores / "baselines.json",
            [
                Baseline(
                    detector=each, dataset=name, images=40, vehicles=200, real=False,
                    ap_centre_1m=sure, clustered_by="places", clusters=20, ap_iou_50=ap,
                    precision=sure, recall=sure, threshold=0.5,
                )
                for each in DETECTORS
            ],
        )  # fmt: skip
    for each in DETECTORS:
        validation = {"ap_centre_1m": 0.9, "ap_iou_50": 0.8, "f1": 0.9}
        about = {"format": 1, "name": each, "threshold": 0.5, "gsd_m": 0.125}
        about |= {"validation": validation, "validation_vehicles": 46, "trained_on": trained_on}
        write_json(own / "detectors" / each / "detector.json", about)


@pytest.fixture
def folder(tmp_path):
    write_scores(tmp_path / "scores" / "000", RATES)
    return tmp_path


def tables(folder):
    part = held_out_part(Reproduction(Results.open(folder)))
    return {table.name: table.rows for table in part.tables}


def test_without_judges_nothing_is_said(folder):
    write_reproduction_report(folder)
    assert tables(folder) == {}
    assert "Judged by" not in (folder / "tables" / "README.md").read_text()
    assert not list((folder / "tables").glob("judges*"))


def test_what_is_hidden_from_each_judge(folder):
    add_judges(folder, "real", {**RATES, "T-U-0": 0.4, "R-U-0": 0.2})
    write_reproduction_report(folder)
    with open(folder / "tables" / "judges.csv", newline="", encoding="utf-8") as file:
        rows = {(row["attack"], row["detector"]): row for row in csv.DictReader(file)}
    assert {attack for attack, _ in rows} == {"T-U", "T-Fc", "S-O@0.4", "R-U", "R-Fc"}
    for judge in (*DETECTORS, "mean"):
        row = rows["T-U", judge]
        # Of five vehicles a tile two are lost, and one of them to chance.
        for prefix in ("", "cycles_"):
            assert float(row[f"{prefix}easr"]) == pytest.approx(40)
            assert float(row[f"{prefix}random_easr"]) == pytest.approx(20)
            assert float(row[f"{prefix}net_easr"]) == pytest.approx(20)
            assert float(row[f"{prefix}easr_low"]) < 40 < float(row[f"{prefix}easr_high"])
        assert rows["R-U", judge]["net_easr"] == "–"
    # The run's own numbers are of its own detectors alone.
    mean = Results.open(folder).quoted[0]
    assert (mean.detector, mean.easr.estimate) == ("mean", pytest.approx(0.8))


def test_an_attack_that_works_only_at_home_says_so_in_the_first_column(folder):
    alike = {"T-U-0": 0.2, "R-U-0": 0.2, "S-O@0.4-0": 0.9, "T-Fc-0": 0.8, "R-Fc-0": 0.2}
    add_judges(folder, "real", alike)
    write_reproduction_report(folder)
    with open(folder / "tables" / "textures.csv", newline="", encoding="utf-8") as file:
        rows = {row["attack"]: row for row in csv.DictReader(file)}
    assert (rows["T-U"]["only_at_home"], rows["T-Fc"]["only_at_home"]) == ("yes", "no")
    assert float(rows["T-U"]["outside_easr_min"]) == pytest.approx(20)
    assert float(rows["T-Fc"]["outside_easr_max"]) == pytest.approx(80)
    page = (folder / "tables" / "README.md").read_text()
    assert "| T-U (only at home) |" in page
    assert "| T-Fc |" in page


def test_nothing_is_said_beside_fewer_chosen_controls_than_the_renderer_has(folder):
    add_judges(folder, "real", RATES)
    own = folder / "judges" / "real" / "scores"
    write_scores(own / "more", {"R-U_plain": 0.1, "R-U_search": 0.5}, found=0.5)
    write_scores(own / "cycles-more", {"R-U_plain": 0.1}, found=0.5, renderer="cycles")
    row = next(row for row in tables(folder)["judges"] if row["attack"] == "T-U")
    assert row["strongest_control"] == "R-U_search"
    assert row["cycles_strongest_control_easr"] is None
    assert row["cycles_net_strongest_control_easr"] is None


def test_what_judges_find_without_camouflage(folder):
    add_judges(folder, "real", RATES)
    clean = tables(folder)["judges_clean"]
    assert [(row["detector"], row["set"], row["ap"]) for row in clean] == [
        (judge, name, pytest.approx(ap))
        for judge in DETECTORS
        for name, ap in (
            ("its own validation", 90),
            ("rendered test", 60),
            ("Blender Cycles test", 60),
        )
    ]
    write_reproduction_report(folder)
    page = (folder / "tables" / "README.md").read_text()
    assert "| RetinaNet | rendered test | 200 | 60.0 (50.0 to 70.0) | 60.0 (50.0 to 70.0)" in page
    assert "Below an AP of 80 % without any camouflage: RetinaNet (60 % on rendered test)" in page
    assert "On Cycles: EASR, net of random draws" in page
    assert "Set against a single draw: T-U, T-Fc." in page
    assert "| attack | RetinaNet: EASR | net | YOLOv5: EASR | net | mean: EASR | net |" in page
    assert "They learnt from “train: tiles of real imagery (a.png)”." in page
    for ending in ("svg", "png"):
        assert (folder / "tables" / f"judges-real.{ending}").stat().st_size > 10_000
    assert "judges-real" not in (folder / "report.html").read_text()  # drawn inside the page
    assert (folder / "report.html").read_text().count("Judged by detectors") == 1


def test_who_sees_well_is_not_doubted(folder):
    add_judges(folder, "real", RATES, ap=0.85)
    write_reproduction_report(folder)
    assert "Below an AP" not in (folder / "tables" / "README.md").read_text()


def test_no_mean_goes_over_two_tables(folder):
    add_judges(folder, "first", {**RATES, "T-U-0": 0.4})
    add_judges(folder, "second", {**RATES, "T-U-0": 1.0}, trained_on="train: others")
    run = Reproduction(Results.open(folder))
    for table, easr in (("first", 40), ("second", 100)):
        rows = [row for row in held_out_rows(run, table) if row["attack"] == "T-U"]
        assert [row["detector"] for row in rows] == detectors_and_mean(run.held_out[table])
        assert [row["easr"] for row in rows] == [pytest.approx(easr)] * 3
    write_reproduction_report(folder)
    page = (folder / "tables" / "README.md").read_text()
    assert page.index("### first: RetinaNet") < page.index("### second: RetinaNet")
    assert "“train: others”" in page


def test_a_table_that_has_judged_nothing_yet_is_left_out(folder):
    add_judges(folder, "real", RATES)
    (folder / "judges" / "new" / "detectors").mkdir(parents=True)
    (folder / "judges" / ".half.partial" / "scores").mkdir(parents=True)
    assert list(Reproduction(Results.open(folder)).held_out) == ["real"]


def test_shapes_keep_the_magnitude_of_the_run(folder):
    add_judges(folder, "real", {**RATES, "S-O@0.7-0": 1.0})
    write_scores(folder / "scores" / "001", {"S-O@0.7-0": 0.91})
    run = Reproduction(Results.open(folder))
    assert run.best["S-O"] == "S-O@0.4"
    attacks = {row["attack"] for row in held_out_rows(run, "real")}
    assert "S-O@0.4" in attacks
    assert "S-O@0.7" not in attacks
