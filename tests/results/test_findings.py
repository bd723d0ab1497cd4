"""Limits and intervals to verdicts and sentences."""

from dataclasses import replace

import pytest

from skyproof.results.precheck import (
    MeasuredOn,
    PrecheckRecord,
    Rate,
    findings,
    misfit_thresholds,
    rate_outcome,
    worst,
)
from skyproof.results.score_folder import Baseline, BestF1
from skyproof.results.statistics.intervals import Interval

SURE = Interval(0.99, 0.98, 1.0)


def check(ap=SURE, *, real=False, recall=0.95, best_recall=0.96, name="Town"):
    return Baseline(
        detector="toy",
        dataset=name,
        images=9,
        vehicles=100,
        real=real,
        ap_centre_1m=ap,
        clustered_by="places",
        clusters=9,
        ap_iou_50=0.9,
        precision=Interval(0.98, 0.97, 0.99),
        recall=Interval(recall, recall - 0.1, recall + 0.04),
        threshold=0.62,
        best=BestF1(0.31, 0.95, best_recall),
    )


def rate(estimate, low, high, kind="paint_body", name="#808000"):
    return Rate(kind, name, 1, Interval(estimate, low, high))


def record(*rates, sets=()):
    on = MeasuredOn(3, "", ("procedural",), 1, 0)
    sets = sets or [check(name="rendered scenes")]
    return PrecheckRecord("toy", "", 0.62, on, sets, rates)


NAN = float("nan")


@pytest.mark.parametrize(
    ("easr", "outcome"),
    [
        ((0.05, -0.2, 0.4), "passed"),
        ((-0.3, -0.5, -0.1), "passed"),
        ((0.06, 0.05, 0.2), "borderline"),
        ((0.06, 0.051, 0.2), "failed"),
        ((1.0, NAN, NAN), "borderline"),  # one tile says nothing for sure
    ],
)
def test_a_change_fails_where_its_whole_interval_lies_beyond(easr, outcome):
    assert rate_outcome(rate(*easr)) == outcome
    assert worst(findings(record(rate(*easr)))).outcome == outcome


@pytest.mark.parametrize(
    ("ap", "real", "outcome"),
    [
        ((0.95, 0.90, 0.97), False, "passed"),
        ((0.94, 0.90, 0.95), False, "borderline"),
        ((0.90, 0.85, 0.949), False, "failed"),
        ((0.86, 0.80, 0.90), True, "passed"),
        ((0.80, 0.70, 0.84), True, "failed"),
    ],
)
def test_average_precision_has_one_limit_for_renders_and_one_for_photographs(ap, real, outcome):
    (found,) = findings(record(sets=[check(Interval(*ap), real=real)]))
    assert found.outcome == outcome


def test_a_low_baseline_tells_what_is_found_by_the_lenient_rule():
    low = replace(check(Interval(0.61, 0.5, 0.7), real=True), ap_centre_in_box=0.9)
    (found,) = findings(record(sets=[replace(low, recall_centre_in_box=0.95)]))
    assert found.outcome == "failed"
    assert found.words.endswith(
        "(limit 85\u202f%), by the lenient rule AP 90\u202f% and recall 95\u202f%"
    )


def test_the_worst_finding_is_the_surest_then_the_largest():
    rates = [
        rate(0.97, 0.90, 0.99),
        rate(0.30, 0.20, 0.40, name="#ffff00"),
        rate(0.99, 0.01, 1.0, "blur", "0.4 px"),
        rate(0.07, 0.06, 0.08, "sun", "10°"),
    ]
    found = findings(record(*rates))
    assert worst(found).words == (
        "2 of 2 plain paints on body panels hide more than 5\u202f%; the worst, "
        "RGB (128, 128, 0), hides 97\u202f% (90 to 99\u202f%)"
    )
    assert [each.outcome for each in found] == ["passed", "failed", "borderline", "failed"]


def test_a_threshold_that_does_not_carry_over_is_named():
    good = check(recall=0.92, best_recall=0.96)
    # What freezing prefers, the lowest threshold of nearly the best F1, gives precision for recall.
    lower = replace(good, precision=Interval(0.90, 0.85, 0.94), recall=Interval(0.94, 0.9, 0.97))
    assert replace(lower, best=BestF1(0.7, 0.98, 0.88)).carries_over
    assert not replace(lower, best=BestF1(0.7, 0.98, 0.94)).carries_over
    bad = check(recall=0.47, best_recall=0.90, name="KIT", real=True)
    assert misfit_thresholds([good, bad]) == [
        "The frozen threshold of toy, 0.62, does not carry over to KIT: recall 47\u202f% at "
        "precision 98\u202f%; the best one there, 0.31, has 90\u202f% at 95\u202f%."
    ]
    # Chance decides the recall of few vehicles.
    assert misfit_thresholds([replace(bad, vehicles=49)]) == []
    assert misfit_thresholds([replace(bad, vehicles=50)])
