"""Intervals that hold the truth as often as they say, and tests against SciPy's."""

import math
import time

import numpy as np
import pytest
from scipy import special, stats

from skyproof.results.statistics.intervals import (
    _effective_limits,
    cluster_interval,
    holm,
    mcnemar_p,
    mean_interval,
    resample,
)
from skyproof.results.statistics.rates import overall_attack_success_rate


def easr(counts):
    return overall_attack_success_rate(counts).mean(axis=-1)


def net(counts):
    rates = overall_attack_success_rate(counts)
    return rates[..., 0] - rates[..., 1]


def clustered(rng, clusters, rate, correlation, gained=0.0):
    """Makes counts `[1, C, 3]` of clustered vehicles.

    Vehicles of each tile share a rate drawn from a beta distribution of mean `rate`.
    """
    return alike(rng, clusters, [rate], correlation, 1.0, gained)


def alike(rng, clusters, rates, correlation, shared, gained=0.0):
    """Series of different mean rates on the same tiles: `[S, C, 3]`.

    Nine in ten of 2 to 11 vehicles a tile are found before. A tile's rates have a beta distribution
    with intra-tile correlation `correlation`; a share `shared` of how a tile differs is common to
    all series. `gained` of the vehicles missed before are found after.
    """
    spread, vehicles, series = (1 - correlation) / correlation, rng.integers(2, 12, clusters), []
    common = rng.normal(size=clusters)
    for rate in rates:
        mixed = math.sqrt(shared) * common + math.sqrt(1 - shared) * rng.normal(size=clusters)
        own = special.betaincinv(rate * spread, (1 - rate) * spread, special.ndtr(mixed))
        found = rng.binomial(vehicles, 0.9)
        lost = rng.binomial(found, own)
        series.append(
            np.stack([found - lost, lost, rng.binomial(vehicles - found, gained)], axis=1)
        )
    return np.stack(series)


# A coverage of 95 % comes out of this many runs with a standard error of 0.5 percentage points.
RUNS = 1600


def coverage(seed, clusters, draw, interval_of, truth):
    """The share of simulated data sets whose interval holds the truth."""
    rng, held = np.random.default_rng(seed), 0
    for run in range(RUNS):
        if run % 20 == 0:
            weights = resample(clusters, generator=rng, replicates=800)
        interval = interval_of(draw(rng), weights)
        held += interval.low <= truth <= interval.high
    return held / RUNS


@pytest.mark.parametrize(
    ("clusters", "rate", "correlation", "gained"),
    [
        (40, 0.5, 0.2, 0.0),
        (40, 0.85, 0.2, 0.0),
        (40, 0.05, 0.1, 0.0),
        (15, 0.7, 0.2, 0.0),
        # Nearly all vehicles of very unlike tiles are lost: a few tiles decide.
        (40, 0.97, 0.2, 0.0),
        (15, 0.9, 0.2, 0.0),
        (100, 0.97, 0.2, 0.0),
        # What a random control looks like: some lost, some gained.
        (40, 0.05, 0.1, 0.2),
    ],
)
def test_coverage(clusters, rate, correlation, gained):
    share = coverage(
        11,
        clusters,
        lambda rng: clustered(rng, clusters, rate, correlation, gained),
        lambda counts, weights: cluster_interval(counts, easr, weights, limits=(-math.inf, 1.0)),
        # One vehicle in ten was missed before, nine were found.
        rate - gained / 9,
    )
    assert 0.93 <= share <= 0.998


@pytest.mark.parametrize(("clusters", "attack", "control"), [(40, 0.8, 0.1), (15, 0.97, 0.05)])
def test_coverage_of_a_paired_difference(clusters, attack, control):
    share = coverage(
        5,
        clusters,
        lambda rng: alike(rng, clusters, [attack, control], 0.2, 0.5, 0.1),
        lambda counts, weights: cluster_interval(counts, net, weights),
        attack - control,
    )
    assert 0.93 <= share <= 0.998


@pytest.mark.parametrize(
    ("clusters", "rate", "shared"), [(40, 0.9, 0.7), (15, 0.7, 0.7), (40, 0.97, 0.7)]
)
def test_coverage_of_a_mean_over_repeats_and_detectors(clusters, rate, shared):
    share = coverage(
        7,
        clusters,
        lambda rng: alike(rng, clusters, [rate] * 9, 0.2, shared, 0.05),
        lambda counts, weights: mean_interval(
            counts, overall_attack_success_rate, weights, (-math.inf, 1.0)
        ),
        rate - 0.05 / 9,
    )
    assert 0.93 <= share <= 0.998


def test_the_effective_limit_of_independent_vehicles_is_the_exact_binomial_one():
    # One vehicle a tile, 30 of 400 kept: the effective number of vehicles is the number of
    # vehicles.
    lost = np.array([0] * 30 + [1] * 370)
    counts = np.stack([1 - lost, lost, 0 * lost], axis=1)
    left_one_out = overall_attack_success_rate(counts.sum(axis=0) - counts)
    low, high = _effective_limits(370 / 400, left_one_out, (0.0, 1.0))
    exact = stats.binomtest(370, 400).proportion_ci(0.95, "exact")
    assert (low, high) == pytest.approx((exact.low, exact.high), abs=0.002)
    assert low < exact.low
    assert high > exact.high


def test_where_few_tiles_decide_the_limit_is_farther_out():
    # The same variance from one tile or spread over many.
    even, single = np.zeros(40), np.zeros(40)
    even[::2], even[1::2] = 1.0, -1.0
    single[0] = 1.0
    single -= single.mean()
    for influence in (even, single):
        influence *= 0.01 / np.linalg.norm(influence)
    assert (
        _effective_limits(0.9, single, (0.0, 1.0))[0]
        < _effective_limits(0.9, even, (0.0, 1.0))[0] - 0.01
    )


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
    first, second = (
        cluster_interval(counts, easr, resample(30, generator=np.random.default_rng(1)))
        for _ in range(2)
    )
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
