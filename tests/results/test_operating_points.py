"""Thresholds at given false alarms, and the rates there, by hand."""

import dataclasses
import json
import math

import numpy as np
import pytest

from skyproof.report.report import write_report
from skyproof.results.operating_points import alarms_in_words, points_of
from skyproof.results.outcomes import write_outcomes
from skyproof.results.result import MEAN
from skyproof.results.results import Results
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import (
    Baseline,
    ScoreRecord,
    SetScore,
    write_record,
)
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample
from tests.results.test_worst import outcome

NOTHING = Interval(math.nan, math.nan, math.nan)


def ground(
    area_km2, scores, clusters=(), *, detector="retinanet", threshold=0.5, vehicles=0, real=False
):
    alarms = sum(score >= threshold for score in scores)
    return Baseline(
        detector, "ground without vehicles", 10, vehicles, real, NOTHING, "images", 10, math.nan,
        NOTHING, NOTHING, threshold, alarms / area_km2, area_km2=area_km2,
        alarm_scores=tuple(scores), alarm_clusters=tuple(clusters),
    )  # fmt: skip


def test_thresholds_lie_midway_between_the_last_alarm_and_the_next():
    frozen, hundred, ten = points_of(ground(0.3, [*(0.9 - i / 100 for i in range(31))]))
    assert (frozen.threshold, frozen.false_alarms_per_km2) == (0.5, 31 / 0.3)
    # 30 and 3 alarms are allowed.
    assert hundred.threshold == pytest.approx((0.61 + 0.60) / 2)
    assert hundred.false_alarms_per_km2 == pytest.approx(100)
    assert ten.threshold == pytest.approx((0.88 + 0.87) / 2)
    assert ten.false_alarms_per_km2 == pytest.approx(10)
    # 30 alarms might be 19 to 41, of which 31 are known; 3 might be 0 to 6.
    assert (hundred.lowest, hundred.highest) == (pytest.approx(0.60), pytest.approx(0.72))
    assert (ten.lowest, ten.highest) == (pytest.approx(0.84), pytest.approx(0.90))
    (said,) = alarms_in_words({"retinanet": [frozen, hundred, ten]})
    assert "100 per km² are at 0.61 (0.60 to 0.72 by chance)." in said


def test_several_alarms_of_one_place_leave_more_to_chance():
    scores = [*(0.9 - i / 100 for i in range(61))]
    # 30 alarms on 10 places might be 11 to 49: 1.96 √(10 · 3²) is 18.6.
    _, hundred, ten = points_of(ground(0.3, scores, [i // 3 for i in range(61)]))
    assert (hundred.lowest, hundred.highest) == (pytest.approx(0.41), pytest.approx(0.80))
    # 3 alarms on one place might be none, or 9.
    assert (ten.lowest, ten.highest) == (pytest.approx(0.81), pytest.approx(0.90))
    assert points_of(ground(0.3, scores, range(61))) == points_of(ground(0.3, scores))


def test_equal_scores_count_together():
    _, hundred, _ = points_of(ground(0.03, [0.9, 0.8, 0.8, 0.8]))
    assert hundred.threshold == pytest.approx(0.85)
    assert hundred.false_alarms_per_km2 == pytest.approx(1 / 0.03)
    _, hundred, _ = points_of(ground(0.03, [0.9] * 4))
    assert math.isnan(hundred.threshold)
    assert hundred.why == "are not reached, because more share the highest score"


def test_what_ground_or_scores_do_not_tell_is_said_in_a_sentence():
    points = points_of(ground(0.05, [0.9, 0.8, 0.7, 0.4]))
    assert [math.isnan(point.threshold) for point in points] == [False, True, True]
    (said,) = alarms_in_words({"retinanet": points})
    assert said == (
        "The frozen threshold of RetinaNet, 0.50, stands at 60 false alarms per km² of empty "
        "ground. 100 per km² are not reached, because all detections, down to a score of 0.40, "
        "make 80. 10 per km² cannot be told on 0.05 km² of empty ground, where 0.5 are expected "
        "and at least 3 are needed."
    )
    # As many alarms as allowed do not tell how low the threshold would be.
    assert points_of(ground(0.04, [0.9, 0.8, 0.7, 0.4]))[1].why
    assert points_of(ground(0.04, [0.9, 0.8, 0.7, 0.4, 0.3]))[1].threshold == 0.35
    assert "because all detections make 0" in alarms_in_words({"a": points_of(ground(1.0, []))})[0]


# By place on every tile: the score without and with T-U, and in the plain paint.
SCORES = [(0.9, 0.0, 0.9), (0.9, 0.4, 0.9), (0.8, 0.7, 0.7), (0.45, 0.1, 0.0), (0.2, 0.0, 0.3)]
ALARMS = [0.99, 0.95, 0.75, 0.6, 0.4, 0.2]


def scored(folder, factors, *, alarms=ALARMS, area_km2=0.04):
    """Two rules, detectors with these factors on all scores, and the frozen threshold 0.5."""
    outcomes = [
        dataclasses.replace(
            outcome(tile, place, camouflage, True, match),
            detector=detector,
            detected_original=before * factor >= 0.5,
            detected_adversarial=after * factor >= 0.5,
            score_original=before * factor,
            score_adversarial=after * factor,
        )
        for detector, factor in factors.items()
        for match in ("centre_1m", "centre_in_box")
        for camouflage, column in (("T-U-0", 1), ("R-U_plain", 2))
        for tile in range(4)
        for place, row in enumerate(SCORES)
        for before, after in [(row[0], row[column])]
    ]
    score = folder / "scores" / "test"
    write_outcomes(score / "outcomes.parquet", outcomes)
    sets = [
        SetScore(camouflage, "torch", detector, match, 0.9, 1.0)
        for detector in factors
        for match in ("centre_1m", "centre_in_box")
        for camouflage in ("original", "T-U-0", "R-U_plain")
    ]
    write_rows(score / "sets.json", sets)
    grounds = [
        ground(area_km2, [alarm * factor for alarm in alarms], detector=detector)
        for detector, factor in factors.items()
    ]
    # Others tell nothing of empty ground.
    others = [ground(0.04, ALARMS, detector=name, vehicles=3) for name in factors]
    others += [ground(0.04, ALARMS, detector=name, real=True) for name in factors]
    others = [dataclasses.replace(one, dataset=f"{n}") for n, one in enumerate(others)]
    write_rows(score / "baselines.json", [*others, *grounds])
    write_record(score, ScoreRecord(dict.fromkeys(factors, 0.5), renderer="torch"))
    return Results.open(folder)


def rates(results, detector, point, match="centre_1m"):
    return next(
        row
        for row in results.equal_alarms
        if (row.detector, row.operating_point, row.match) == (detector, point, match)
        and str(row.camouflage) == "T-U"
    )


def test_rates_at_equal_alarms_do_not_depend_on_the_scale_of_scores(tmp_path):
    results = scored(tmp_path, {"retinanet": 1.0, "faster_rcnn": 0.6})
    strict = [row for row in results.rows if row.match == "centre_1m"]
    frozen = {row.detector: row for row in strict if str(row.camouflage) == "T-U"}
    # Found are three and two of five, hidden are two and one of these.
    assert (frozen["retinanet"].found_before, frozen["retinanet"].easr.estimate) == (0.6, 2 / 3)
    assert (frozen["faster_rcnn"].found_before, frozen["faster_rcnn"].easr.estimate) == (0.4, 1.0)
    for detector in ("retinanet", "faster_rcnn", MEAN):
        for match in ("centre_1m", "centre_in_box"):
            # Four alarms are allowed on 0.04 km², so the threshold is halfway from 0.6 to 0.4.
            row = rates(results, detector, "100_per_km2", match)
            assert (row.found_before, row.easr.estimate) == (0.6, 2 / 3)
            assert row.strongest.net.estimate == pytest.approx(2 / 3)
            assert math.isnan(row.false_alarms_per_km2_original)
            assert row.ap_original == 0.9
    assert {row.operating_point for row in results.equal_alarms} == {"100_per_km2"}
    assert results.at(frozen["retinanet"], "100_per_km2") is rates(
        results, "retinanet", "100_per_km2"
    )
    assert results.at(frozen["retinanet"], "10_per_km2") is None


def test_intervals_cover_the_thresholds_that_chance_might_have_set(tmp_path):
    results = scored(tmp_path, {"retinanet": 1.0, "faster_rcnn": 0.6})
    frozen = next(row for row in results.rows if str(row.camouflage) == "T-U")
    row = rates(results, "retinanet", "100_per_km2")
    assert (frozen.detector, frozen.easr.estimate) == ("retinanet", row.easr.estimate)
    # 4 alarms might be 0 to 8: from a threshold of 0.99, which finds nothing, to the last of 0.2,
    # at which T-U hides three of five.
    assert [row.easr.high, row.easr.errors["thresholds"]] == pytest.approx(
        [frozen.easr.high, (2 / 3 - 3 / 5) / 2 / 1.96], rel=1e-4
    )
    below = [one.easr.estimate - one.easr.low for one in (row, frozen)]
    assert below[0] == pytest.approx(math.hypot(below[1], 2 / 3 - 3 / 5))
    assert row.json()["easr_threshold_se"] == row.easr.errors["thresholds"]
    assert frozen.json()["easr_threshold_se"] is None
    # There the plain paint hides one of five, and none at the frozen threshold.
    below = [one.estimate - one.low for one in (row.strongest.net, frozen.strongest.net)]
    assert below[0] == pytest.approx(math.hypot(below[1], 2 / 3 - (3 / 5 - 1 / 5)))


@pytest.mark.parametrize("largest", [1, 5])
def test_nineteen_of_twenty_intervals_hold_the_rate_at_the_true_threshold(largest):
    """Alarms come alone, or one to five of a place have almost the same score."""
    generator = np.random.default_rng(0)
    tiles = [(f"tile {n}", f"vehicle {n}") for n in range(200)]
    held = {"with": 0, "difference": 0, "without": 0}
    runs = 200
    for _ in range(runs):
        # 1,000 alarms per km² above a score of 0, uniformly: 100 above 0.9.
        places = generator.random(generator.poisson(350 * 2 / (1 + largest)))
        cluster = np.repeat(np.arange(len(places)), generator.integers(1, largest + 1, len(places)))
        alarms = places[cluster] + generator.normal(0, 1e-3, len(cluster))
        kept = np.argsort(-alarms)[:72]
        point = points_of(ground(0.35, alarms[kept].tolist(), cluster[kept].tolist()))[1]
        # Half of the vehicles with T-U score below 0.9, a quarter of those with a control.
        scores = generator.uniform([0.7, 0.8], [1.1, 1.2], size=(200, 2)).T
        thresholds = (point.threshold, point.lowest, point.highest)
        counts = [
            np.stack([scores >= at, scores < at, np.zeros((2, 200), bool)], axis=-1).astype(int)
            for at in thresholds
        ]
        sample = Sample.draw(tiles, generator=generator, replicates=100)
        sure = [Group(counts[0][[each]], sample) for each in (0, 1)]
        moved = [
            dataclasses.replace(group, ends=[end[[each]] for end in counts[1:]])
            for each, group in enumerate(sure)
        ]
        for name, truth, interval in (
            ("with", 0.5, mean_interval(moved[0])),
            ("difference", 0.25, difference_interval(moved[:1], moved[1:])),
            ("without", 0.5, mean_interval(sure[0])),
        ):
            held[name] += interval.low <= truth <= interval.high
    assert held["with"] >= 0.93 * runs
    assert held["difference"] >= 0.93 * runs
    assert held["without"] < 0.85 * runs


def test_a_lower_threshold_finds_more(tmp_path):
    results = scored(tmp_path, {"retinanet": 1.0}, alarms=[0.9, 0.8, 0.7, 0.4, 0.35])
    row = rates(results, "retinanet", "100_per_km2")
    # 0.375: four of five are found, and T-U leaves two of them.
    assert (row.found_before, row.easr.estimate) == (0.8, 0.5)


def test_a_detector_without_low_scores_is_left_out_and_so_is_the_mean(tmp_path):
    scored(tmp_path, {"retinanet": 1.0, "faster_rcnn": 0.6, "yolov5": 0.8})
    place = tmp_path / "scores" / "test" / "baselines.json"
    document = json.loads(place.read_text())
    document["rows"][-1]["alarm_scores"] = [0.9]
    place.write_text(json.dumps(document))
    results = Results.open(tmp_path)
    assert {row.detector for row in results.equal_alarms} == {"retinanet", "faster_rcnn"}


def test_the_report_and_its_files_have_every_operating_point(tmp_path):
    scored(tmp_path, {"retinanet": 1.0, "faster_rcnn": 0.6})
    page = write_report(tmp_path).read_text()
    stored = json.loads((tmp_path / "results.json").read_text())
    assert {row["operating_point"] for row in stored["rows"]} == {"frozen"}
    (mean,) = [
        row
        for row in stored["equal_alarms"]
        if (row["camouflage"], row["detector"], row["match"]) == ("T-U", MEAN, "centre_1m")
    ]
    assert (mean["operating_point"], mean["found_before"]) == ("100_per_km2", 0.6)
    assert [one["threshold"] for one in stored["operating_points"]] == [
        *(0.5, 0.5, None),
        *(0.5, pytest.approx(0.3), None),
    ]
    table = page.partition("At equal false alarms")[2].partition("</table>")[0]
    cells = [text.partition("<")[0] for text in table.split("<td>")]
    assert [cell for cell in cells if cell.endswith("%")][:2] == ["50\u202f%", "60\u202f%"]
    assert "The frozen threshold of Faster R-CNN, 0.50, stands at 50 false alarms" in page
    assert "10 per km² cannot be told on 0.04 km²" in page


def test_without_empty_ground_nothing_is_claimed(tmp_path):
    scored(tmp_path, {"retinanet": 1.0})
    write_rows(tmp_path / "scores" / "test" / "baselines.json", [])
    page = write_report(tmp_path).read_text()
    assert "At equal false alarms" not in page
    assert "so the false alarms at the frozen threshold are not known" in page
