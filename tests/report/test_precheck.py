"""The first lines of a report: its detectors passed the gate, failed it, or were not checked."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from skyproof.camouflage.paint import LATTICE
from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.report.report import write_report
from skyproof.results.precheck import MeasuredOn, PrecheckRecord, Rate, write_precheck
from skyproof.results.score_folder import Baseline, BestF1
from skyproof.results.statistics.intervals import Interval
from skyproof.scenes.scene import (
    BackgroundWindow,
    Camera,
    Scene,
    Sun,
    scenes_digest,
    write_scenes,
)
from tests.report.fabricate import fabricate
from tests.report.test_report import first_lines, words_of

THRESHOLD = 0.5


@pytest.fixture(scope="module")
def fabricated(tmp_path_factory):
    return fabricate(tmp_path_factory.mktemp("run"), scenes=4)


@pytest.fixture
def run_folder(fabricated, tmp_path):
    return Path(shutil.copytree(fabricated, tmp_path / "run"))


def test_who_failed_the_check_is_no_witness_that_the_ground_is_clear(run_folder):
    config = json.loads((run_folder / "config.json").read_text())
    write_json(run_folder / "config.json", config | {"imagery": ["Selwyn 2012"]})
    totals = {"labelled_removed": 7, "detected_removed": 0, "masked_share": 0.01}
    clearing = {
        "totals": totals,
        "checked_by": {"name": "runs/town/detectors/retinanet (0123abcd)"},
    }
    (run_folder / "backgrounds").mkdir(exist_ok=True)
    write_json(run_folder / "backgrounds/clearing.json", clearing)
    checked(run_folder, "retinanet", {})
    trusted = first_lines(write_report(run_folder).read_text())
    assert "7 vehicles were removed from the photographs" in trusted
    assert "searched for remaining vehicles" not in trusted
    (run_folder / "detectors/retinanet/precheck.json").unlink()
    checked(run_folder, "retinanet", {("paint_body", "#ffffff"): Interval(0.6, 0.5, 0.7)})
    doubted = first_lines(write_report(run_folder).read_text())
    assert (
        "RetinaNet searched for remaining vehicles, but it failed its precheck. Look at backgrounds"
        in doubted
    )


def clean(name, recall, best_recall, *, real=False):
    sure = Interval(0.99, 0.97, 1.0)
    return Baseline(
        "retinanet",
        name,
        60,
        180,
        real,
        sure,
        "places",
        40,
        0.9,
        Interval(0.98, 0.96, 0.99),
        Interval(recall, recall - 0.05, recall + 0.02),
        THRESHOLD,
        best=BestF1(0.31, 0.95, best_recall),
    )


def checked(
    folder,
    detector,
    hidden,
    *,
    threshold=THRESHOLD,
    scenes=(60, ""),
    tiles=0,
    rendered=0.99,
    found_instead=0.0,
    likeness=(),
):
    """Gives a detector of a run a record: what each paint of `hidden` hides, all others nothing.

    With `tiles`, five vehicles are found on each, and lost by the same share, or by one that is
    larger by those `found_instead`.
    """
    nothing = Interval(0.0, -0.02, 0.02)
    rates = []
    for kind in ("paint_body", "paint_whole"):
        for colour in LATTICE:
            name = f"#{bytes(colour).hex()}"
            easr = hidden.get((kind, name), nothing)
            lost = (max(round(5 * (easr.estimate + found_instead)), 0),) * tiles
            rates.append(Rate(kind, name, 1, easr, lost))
    rates += [Rate("blur", "0.7 px", 1, nothing), Rate("control", "R-U", 5, nothing)]
    sets = [clean("rendered scenes", 0.97, 0.98), clean("KIT", 0.47, 0.9, real=True)]
    sure = Interval(rendered, rendered - 0.02, rendered + 0.01)
    sets[0] = replace(sets[0], ap_centre_1m=sure, detector=detector)
    sets[1] = replace(sets[1], detector=detector)
    on = MeasuredOn(*scenes, ("procedural",), 5, 0)
    compared = [replace(row, detector=detector) for row in likeness]
    record = PrecheckRecord(detector, "", threshold, on, sets, rates, (5,) * tiles, compared)
    place = folder / "detectors" / detector
    card = json.loads((place / "detector.json").read_text())
    write_json(place / "detector.json", {**card, "threshold": THRESHOLD, "weights_sha256": ""})
    write_precheck(place, record)


def told(folder):
    """The page up to the attacks."""
    text = words_of(write_report(folder).read_text()).replace("\u202f", " ")
    return text[: text.index("What each attack hides")]


def test_detectors_that_were_not_checked_are_named_first(run_folder):
    lines = told(run_folder)
    unchecked = ": no precheck."
    for name in ("RetinaNet", "Faster R-CNN"):
        assert f"{name}{unchecked}" in lines
    assert lines.index(unchecked) < lines.index("Synthetic")
    assert "Changes without optimisation" not in lines


def test_passed_and_failed_are_named_first_with_the_worst_finding(run_folder):
    olive = ("paint_body", "#808000")
    checked(run_folder, "retinanet", {olive: Interval(0.97, 0.9, 0.99)})
    checked(run_folder, "faster_rcnn", {})
    lines = told(run_folder)
    assert (
        "RetinaNet: precheck FAILED. 1 of 27 plain paints on "
        "body panels hides more than 5 %; the worst, RGB (128, 128, 0), hides 97 % (90 to 99 %). "
        "Faster R-CNN: precheck passed. "
    ) in lines
    assert (
        "The frozen threshold of RetinaNet, 0.50, does not carry over to KIT: recall 47 % at "
        "precision 98 %; the best one there, 0.31, has 90 % at 95 %."
    ) in lines
    assert "may lose vehicles for the reason" in lines
    page = (run_folder / "report.html").read_text()
    assert page.count('class="swatch failed" style="background:#808000') == 1
    assert page.count('class="swatch passed"') == 4 * 27 - 1
    text = words_of(page).replace("\u202f", " ")
    assert "plain paints on body panels failed RGB (128, 128, 0) 97 % (90 to 99 %)" in text


def test_a_threshold_left_to_chance_is_told_though_the_check_is_passed(run_folder):
    checked(run_folder, "retinanet", {})
    card = run_folder / "detectors" / "retinanet" / "detector.json"
    assert "chance decides it" not in told(run_folder)
    write_json(card, {**json.loads(card.read_text()), "validation_vehicles": 5})
    (run_folder / "report.html").unlink()
    assert (
        "The threshold of RetinaNet was chosen on 5 vehicles, and with fewer than 50 chance "
        "decides it"
    ) in told(run_folder)


def test_borderline_is_neither(run_folder):
    checked(run_folder, "retinanet", {("paint_whole", "#ffff00"): Interval(0.08, -0.01, 0.2)})
    lines = told(run_folder)
    assert "RetinaNet: precheck borderline. 1 of 27" in lines
    assert "may lose vehicles for the reason" not in lines


def test_photographs_of_the_precheck_count_where_the_scores_have_none(run_folder):
    """Else one part of the page denies what another tells."""
    place = run_folder / "scores" / "main" / "baselines.json"
    rows = json.loads(place.read_text())["rows"]
    write_json(place, {"rows": [row for row in rows if not row["real"]]})
    assert "not tested on real vehicles" in told(run_folder)
    checked(run_folder, "retinanet", {})
    lines = told(run_folder)
    assert "not tested on real vehicles" not in lines
    assert "they score an AP of 99 % (RetinaNet, 97 to 100 %) on KIT." in lines
    assert "Measure the detectors on annotated photographs" not in lines
    # Renders of both kinds stay apart.
    assert "rendered scenes (rendered)" not in lines


def test_a_paint_with_which_more_are_found_says_so(run_folder):
    checked(run_folder, "retinanet", {("paint_whole", "#ffff00"): Interval(-0.53, -0.9, -0.2)})
    told(run_folder)
    page = (run_folder / "report.html").read_text().replace("\u202f", " ")
    assert 'title="RGB (255, 255, 0) is found 53 % more often (−90 to −20 %)">↓</span>' in page
    assert page.count(">↓</span>") == 1


def test_a_check_on_other_scenes_than_the_runs_is_told(run_folder):
    window = BackgroundWindow("tile", 100.0, 100.0, 0.0)
    camera, sun = Camera(0.1, 0.2, 0.125, 96), Sun(0.3, 0.8)
    scenes = [Scene(f"test-{number}", window, camera, sun, (), number) for number in range(5)]
    write_scenes(run_folder / "scenes" / "test.jsonl", scenes)
    # The check takes the first of the run's scenes; in others a single number may differ.
    checked(run_folder, "retinanet", {}, scenes=(3, scenes_digest(scenes[:3])))
    assert "was made earlier" not in told(run_folder)
    checked(run_folder, "faster_rcnn", {}, scenes=(3, scenes_digest(scenes[1:4])))
    (run_folder / "report.html").unlink()
    assert (
        "The precheck of Faster R-CNN was made earlier, on 3 scenes of procedural ground, not on "
        "the scenes of this run."
    ) in told(run_folder)


def test_a_record_of_another_threshold_counts_for_nothing(run_folder):
    checked(run_folder, "retinanet", {}, threshold=0.4)
    assert "RetinaNet: no precheck" in told(run_folder)


def test_a_damaged_record_is_refused(run_folder):
    checked(run_folder, "retinanet", {})
    (run_folder / "detectors" / "retinanet" / "precheck.json").write_text("{}")
    with pytest.raises(StoredFileError, match=r"check\.json"):
        write_report(run_folder)
