"""The worst case over several attacks, against counts by hand."""

import json
import re

import pytest

from skyproof.files import write_json
from skyproof.report.report import write_report
from skyproof.results.outcomes import Outcome, write_outcomes
from skyproof.results.results import Results
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import ScoreRecord, SetScore, write_record
from skyproof.results.worst import worst_cases

NAN = float("nan")
TILES = 20
# By camouflage: of the five vehicles of every tile, those that it hides. The last is never found
# before. A second repeat and the copy of an unfinished attack would be further tries.
HIDES = {
    "T-U-0": {0, 1},
    "T-U-1": {0, 1, 2},
    "T-U_step1-0": {3},
    "T-Ma-0": {1, 2, 4},
    "R-U-0": {0},
    "R-Ma-0": {0},
    "R-U-1": {0},
    "R-Ma-1": {3},
    "R-U_plain": {0, 1, 2, 3},
}


MANY = {
    **{name: {0} for name in ("T-Ma", "T-Fc", "T-PixFc", "T-PixFcMa", "R-U-0")},
    "T-U": {0, 1, 2},
}


def outcome(tile, place, camouflage, after, match):
    before = place != 4
    return Outcome(
        scene=f"scene-{tile}",
        placement=place,
        vehicle=f"saloon-{place}",
        body_type="saloon",
        background=f"tile-{tile}",
        camouflage=camouflage,
        renderer="torch",
        detector="retinanet",
        match=match,
        detected_original=before,
        detected_adversarial=after,
        score_original=0.9 * before,
        score_adversarial=0.9 * after,
        distance_original_m=0.1 if before else NAN,
        distance_adversarial_m=0.1 if after else NAN,
        visible_fraction=1.0,
        sun_elevation_deg=40.0,
        sun_azimuth_deg=0.0,
        tilt_deg=0.0,
        camera_azimuth_deg=0.0,
        heading_deg=0.0,
        heading_to_sun_deg=0.0,
    )


def scored(folder, hides, leniently=None):
    """Scores camouflages that hide these vehicles of every tile, and leniently maybe others."""
    by_rule = {"centre_1m": hides, "iou_50": hides}
    by_rule |= {"centre_in_box": leniently} if leniently else {}
    score = folder / "scores" / "test"
    outcomes = [
        outcome(tile, place, camouflage, place not in hidden, match)
        for match, rates in by_rule.items()
        for camouflage, hidden in rates.items()
        for tile in range(TILES)
        for place in range(5)
    ]
    write_outcomes(score / "outcomes.parquet", outcomes)
    sets = [
        SetScore(name, "torch", "retinanet", match, 0.9, 1.0)
        for name in ("original", *hides)
        for match in by_rule
    ]
    write_rows(score / "sets.json", sets)
    write_record(score, ScoreRecord({"retinanet": 0.5}, renderer="torch"))
    write_json(score / "baselines.json", {"rows": []})
    return Results.open(folder)


def test_what_any_attack_hides_counts_and_what_was_never_found_does_not(tmp_path):
    (case,) = worst_cases(scored(tmp_path, HIDES))
    assert [str(name) for name in case.attacks] == ["T-U", "T-Ma"]
    assert case.hidden.estimate == 3 / 4
    assert case.hidden.low <= 3 / 4 <= case.hidden.high
    assert (str(case.strongest), case.alone) == ("T-U", 2 / 4)
    # Two sets of draws: the first hides one vehicle of four, the second two.
    assert case.random == pytest.approx((1 / 4 + 2 / 4) / 2)
    assert case.net.estimate == pytest.approx(3 / 4 - 3 / 8)


def test_one_attack_has_no_worst_case(tmp_path):
    assert worst_cases(scored(tmp_path, {"T-U-0": {0}, "T-U-1": {1}, "R-U-0": {2}})) == []


def test_without_a_draw_of_every_control_there_is_none_to_compare(tmp_path):
    few = {name: HIDES[name] for name in ("T-U-0", "T-Ma-0", "R-U-0")}
    (case,) = worst_cases(scored(tmp_path, few))
    assert (case.random, case.net) == (None, None)


def test_a_detector_that_found_nothing_before_has_none(tmp_path):
    results = scored(tmp_path, HIDES)
    outcomes = [outcome(0, 4, name, False, "centre_1m") for name in HIDES]
    write_outcomes(results.scores[0].path / "outcomes.parquet", outcomes)
    assert worst_cases(results) == []


def test_it_stands_in_results_and_report(tmp_path):
    scored(tmp_path, HIDES)
    page = write_report(tmp_path).read_text()
    (row,) = json.loads((tmp_path / "results.json").read_text())["worst_cases"]
    assert (row["hidden"], row["strongest"], row["attacks"]) == (0.75, "T-U", ["T-U", "T-Ma"])
    assert "At least one of the 2 attacks hides 75\u202f%" in page
    assert "The strongest alone, T-U, hides 50\u202f%" in page


def test_of_many_the_strongest_is_shown_in_full(tmp_path):
    scored(tmp_path, {name: places | {4} for name, places in MANY.items()})
    page = write_report(tmp_path).read_text()
    assert re.search(r"<h3>The strongest attack: [^<]* \(T-U\)</h3>", page)
    assert "<h2>What it looks like: T-U</h2>" in page
    assert "<h2>Success by condition: T-U</h2>" in page
    others = page[page.index("<h2>What the other attacks look like</h2>") :]
    assert re.search("<h3>[^<]*T-Ma[^<]* hides 25", others)
    assert not re.search(r"<h3>[^<]*T-U\b[^<]* hides ", others)


def test_attacks_that_share_a_control_have_a_draw_of_it_each(tmp_path):
    # Each draw hides a vehicle of its own: two tries hide two of four, one alone would hide one.
    drawn = {f"R-C-Fc@0.2-{draw}": {draw % 4, 4} for draw in range(5)}
    hides = {"C-Fc-seq@0.2": {0, 4}, "C-Fc-par@0.2": {1, 4}, **drawn}
    (case,) = worst_cases(scored(tmp_path, hides))
    assert case.random == pytest.approx(0.5)
    assert case.net is not None
    assert case.net.estimate == pytest.approx(0.0)
