"""Intervals that hold the truth as often as they say."""

import math
import time

import jaxtyping
import numpy as np
import pytest
from scipy import stats

from skyproof.results.statistics.intervals import (
    _jackknife,
    cluster_interval,
    effective_limits,
    overall_attack_success_rate,
    resample,
    superiority_interval,
)
from tests.results.simulated import STARTS, WORLDS, coverage


def easr(counts):
    return overall_attack_success_rate(counts).mean(axis=-1)


def net(counts):
    rates = overall_attack_success_rate(counts)
    return rates[..., 0] - rates[..., 1]


def clustered(rng, clusters, rate, correlation):
    """Makes counts `[1, C, 3]` of 2 to 11 vehicles a tile, whose rates have a beta distribution."""
    spread, vehicles = (1 - correlation) / correlation, rng.integers(2, 12, clusters)
    own = rng.beta(rate * spread, (1 - rate) * spread, clusters)
    found = rng.binomial(vehicles, 0.9)
    lost = rng.binomial(found, own)
    return np.stack([found - lost, lost, 0 * lost], axis=1)[None]


# A coverage of 95 % comes out of this many runs with a standard error of 0.8 percentage points, and
# of 300 with one of 1.3.
RUNS = 800


@pytest.fixture
def unchecked(monkeypatch):
    """Every other test checks shapes; here it would take most of the time."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", STARTS)
def test_one_start_or_several_hold_the_truth(name):
    held, _ = coverage(STARTS[name], runs=100, seed=3)
    assert held >= 0.93


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", WORLDS)
def test_coverage(name):
    many = "30 draws" in name or "10 draws" in name
    held, _ = coverage(WORLDS[name], runs=300 if many else RUNS, seed=11)
    # Three draws that differ by nearly all that rates can differ leave next to everything open.
    assert 0.93 <= held <= (1.0 if "3 draws" in name else 0.999)


def test_the_effective_limit_of_independent_vehicles_is_the_exact_binomial_one():
    # One vehicle a tile, 30 of 400 kept: the effective number of vehicles is the number of
    # vehicles.
    lost = np.array([0] * 30 + [1] * 370)
    counts = np.stack([1 - lost, lost, 0 * lost], axis=1)
    left_one_out = overall_attack_success_rate(counts.sum(axis=0) - counts)
    low, high = effective_limits(370 / 400, *_jackknife(left_one_out), (0.0, 1.0))
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
    lowest = [effective_limits(0.9, *_jackknife(each), (0.0, 1.0))[0] for each in (single, even)]
    assert lowest[0] < lowest[1] - 0.01


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


def test_tiles_on_which_nothing_was_found_before_agree_with_nobody(rng):
    counts = np.zeros((1, 38, 3), dtype=int)
    counts[0, :4, 1] = [2, 1, 1, 1]
    interval = cluster_interval(counts, easr, resample(38, generator=rng), limits=(-math.inf, 1.0))
    assert interval.estimate == 1
    assert interval.low == pytest.approx(stats.binomtest(4, 4).proportion_ci(0.95, "exact").low)


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


def superiority(first, second, of_first, of_second, seed=0):
    weights = resample(int(max(of_first)) + 1, generator=np.random.default_rng(seed))
    arrays = (np.asarray(each) for each in (first, second, of_first, of_second))
    return superiority_interval(*arrays, weights)


def test_the_chance_of_a_larger_value_is_that_of_mann_and_whitney():
    rng = np.random.default_rng(3)
    first, second = rng.integers(0, 9, 40).astype(float), rng.integers(2, 12, 60).astype(float)
    found = superiority(first, second, np.arange(40) % 8, np.arange(60) % 8)
    expected = stats.mannwhitneyu(first, second).statistic / (40 * 60)
    assert found.estimate == pytest.approx(expected, abs=1e-12)
    assert found.low < expected < found.high
    other = superiority(second, first, np.arange(60) % 8, np.arange(40) % 8)
    assert other.estimate == pytest.approx(1 - expected, abs=1e-12)


def test_values_that_are_all_larger_leave_the_exact_binomial_limit_of_the_tiles():
    found = superiority([3.0] * 10, [1.0] * 10, [*range(5)] * 2, [*range(5)] * 2)
    assert (found.estimate, found.high) == (1.0, 1.0)
    assert found.low == pytest.approx(0.025 ** (1 / 5))


@pytest.mark.usefixtures("unchecked")
def test_the_interval_of_the_chance_holds_it_where_tiles_differ():
    """Normal values of which a fifth of the variance is the tile's own, of each kind."""
    rng = np.random.default_rng(5)
    truth = stats.norm.cdf(0.8 / math.sqrt(2))
    held = 0
    for run in range(200):
        tiles = [np.repeat(np.arange(12), rng.integers(1, 9, 12)) for _ in range(2)]
        values = [
            mean + rng.normal(0, 0.2**0.5, 12)[tile] + rng.normal(0, 0.8**0.5, len(tile))
            for mean, tile in zip((0.8, 0.0), tiles, strict=True)
        ]
        found = superiority(*values, *tiles, seed=run)
        held += found.low <= truth <= found.high
    assert held >= 184
