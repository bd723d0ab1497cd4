"""Intervals that hold the truth as often as they say, and tests against SciPy's."""

import math
import time

import numpy as np
import pytest
from scipy import stats

from skyproof.evaluate.intervals import cluster_interval, holm, mcnemar_p, resample
from skyproof.evaluate.rates import overall_attack_success_rate


def easr(counts):
    return overall_attack_success_rate(counts).mean(axis=-1)


def net(counts):
    rates = overall_attack_success_rate(counts)
    return rates[..., 0] - rates[..., 1]


def clustered(rng, clusters, rate, correlation):
    """Vehicles of each tile share a rate drawn from a beta distribution of mean `rate`: `[1, C, 3]`."""
    spread = (1 - correlation) / correlation
    detected = rng.binomial(rng.integers(2, 12, clusters), 0.9)
    lost = rng.binomial(detected, rng.beta(rate * spread, (1 - rate) * spread, clusters))
    return np.stack([detected - lost, lost, np.zeros(clusters, dtype=int)], axis=1)[None]


@pytest.mark.parametrize(
    ("clusters", "rate", "correlation", "at_least"),
    [
        (40, 0.5, 0.2, 0.93),
        (40, 0.85, 0.2, 0.93),
        (40, 0.05, 0.1, 0.93),
        (15, 0.7, 0.2, 0.92),
        # Rates this near 1 with tiles this unlike stay a little below; the module says so.
        (40, 0.97, 0.2, 0.89),
    ],
)
def test_coverage(clusters, rate, correlation, at_least):
    rng, held, runs = np.random.default_rng(11), 0, 400
    for _ in range(runs):
        counts = clustered(rng, clusters, rate, correlation)
        interval = cluster_interval(
            counts, easr, resample(clusters, generator=rng, replicates=1000), limits=(-9.0, 1.0)
        )
        held += interval.low <= rate <= interval.high
    assert at_least <= held / runs <= 0.995


def test_coverage_of_a_paired_difference():
    rng, held, runs, clusters = np.random.default_rng(5), 0, 400, 40
    for _ in range(runs):
        counts = np.concatenate([clustered(rng, clusters, 0.8, 0.2), clustered(rng, clusters, 0.1, 0.1)])
        interval = cluster_interval(counts, net, resample(clusters, generator=rng, replicates=1000))
        held += interval.low <= 0.7 <= interval.high
    assert held / runs >= 0.93


def test_tiles_are_resampled_not_vehicles(rng):
    # Ten tiles, each wholly lost or wholly kept: ten observations, however many vehicles.
    lost = np.array([1, 0] * 5)
    few = np.stack([1 - lost, lost, 0 * lost], axis=1)[None]
    weights = resample(10, generator=rng)
    one, hundred = cluster_interval(few, easr, weights), cluster_interval(few * 100, easr, weights)
    assert (hundred.low, hundred.high) == pytest.approx((one.low, one.high))
    assert one.low < 0.25
    assert one.high > 0.75


def test_pairing_takes_out_what_tiles_share(rng):
    shared = clustered(rng, 40, 0.5, 0.5)
    interval = cluster_interval(np.concatenate([shared, shared]), net, resample(40, generator=rng))
    assert interval.estimate == 0
    single = cluster_interval(shared, easr, resample(40, generator=rng))
    assert interval.high - interval.low < (single.high - single.low)


def test_unanimous_tiles_still_have_an_interval(rng):
    counts = np.tile([0, 3, 0], (20, 1))[None]
    interval = cluster_interval(counts, easr, resample(20, generator=rng), limits=(-math.inf, 1.0))
    assert interval.estimate == 1
    assert interval.high == 1
    # The exact one-sided 97.5 % limit for 20 successes in 20 trials.
    assert interval.low == pytest.approx(stats.binomtest(20, 20).proportion_ci(0.95, "exact").low)


def test_undefined(rng):
    nothing = cluster_interval(np.zeros((1, 5, 3), dtype=int), easr, resample(5, generator=rng))
    assert all(math.isnan(value) for value in (nothing.estimate, nothing.low, nothing.high))
    one_tile = cluster_interval(np.array([[[1, 3, 0]]]), easr, resample(1, generator=rng))
    assert one_tile.estimate == 0.75
    assert math.isnan(one_tile.low)


def test_the_estimate_lies_inside_and_the_seed_decides(rng):
    counts = clustered(rng, 30, 0.6, 0.2)
    first, second = (cluster_interval(counts, easr, resample(30, generator=np.random.default_rng(1))) for _ in range(2))
    assert first == second
    assert first.low < first.estimate < first.high


def test_two_thousand_replicates_take_well_under_a_second(rng):
    counts = np.concatenate([clustered(rng, 300, 0.6, 0.2)] * 12)
    start = time.process_time()
    cluster_interval(counts, easr, resample(300, generator=rng))
    assert time.process_time() - start < 1


@pytest.mark.parametrize(("lost", "gained"), [(0, 0), (1, 0), (5, 5), (12, 3), (3, 12), (60, 2)])
def test_mcnemar_equals_the_exact_binomial_test(lost, gained):
    expected = stats.binomtest(lost, lost + gained, 0.5).pvalue if lost + gained else 1.0
    assert mcnemar_p(lost, gained) == pytest.approx(expected)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []
