"""Success rates on hand-counted pairs."""

import math
from typing import get_type_hints

import numpy as np
import pytest

from skyproof.results.outcomes import Outcome
from skyproof.results.statistics import intervals
from tests.results.counted import count_outcomes


def pair_counts(original, adversarial):
    """Counts vehicles by (both, lost, gained), on one tile."""
    blank = {
        name: {str: "x", int: 0, bool: False, float: 0.0}[kind]
        for name, kind in get_type_hints(Outcome).items()
    }
    pairs = zip(original.tolist(), adversarial.tolist(), strict=True)
    outcomes = [
        Outcome(
            **{
                **blank,
                "match": "iou_50",
                "detected_original": before,
                "detected_adversarial": after,
            }
        )
        for before, after in pairs
    ]
    (counts,) = count_outcomes(outcomes).series.values()
    return counts[0, 1:]


def test_rates_of_hand_counted_pairs():
    original = np.array([1, 1, 1, 1, 1, 0, 0, 0], dtype=bool)
    adversarial = np.array([1, 0, 0, 0, 1, 1, 0, 0], dtype=bool)
    counts = pair_counts(original, adversarial)
    assert counts.tolist() == [2, 3, 1]
    assert float(intervals.attack_success_rate(counts)) == pytest.approx(3 / 5)
    assert float(intervals.enhancement_rate(counts)) == pytest.approx(1 / 5)
    assert float(intervals.overall_attack_success_rate(counts)) == pytest.approx(2 / 5)


def test_easr_is_one_minus_the_ratio_of_true_positives(rng):
    original, adversarial = rng.random(500) < 0.9, rng.random(500) < 0.4
    counts = pair_counts(original, adversarial)
    assert float(intervals.overall_attack_success_rate(counts)) == pytest.approx(
        1 - adversarial.sum() / original.sum()
    )


def test_undefined_when_nothing_was_detected_before():
    counts = np.array([[0, 0, 4], [1, 1, 0]])
    easr = intervals.overall_attack_success_rate(counts)
    assert math.isnan(easr[0])
    assert easr[1] == 0.5


def test_false_alarms_per_area():
    # 20 images of 48 m x 48 m.
    assert intervals.false_alarms_per_km2(3, 20 * 48.0**2) == pytest.approx(
        3 / (20 * 48 * 48) * 1e6
    )
    assert math.isnan(intervals.false_alarms_per_km2(0, 0.0))
