"""Differences of success rates: cases worked out by hand, and how often the interval holds the truth."""

import math

import numpy as np
import pytest

from skyproof.results.statistics.differences import difference_interval
from skyproof.results.statistics.intervals import cluster_interval, resample
from skyproof.results.statistics.rates import success_difference

TILES, VEHICLES = 40, 6
MARGIN = 1 - 0.025 ** (1 / TILES)


def stack(*lost):
    """Pair counts of series: of `VEHICLES` found before on every tile, so many are lost."""
    rows = [np.broadcast_to(each, TILES) for each in lost]
    return np.array([np.stack([VEHICLES - row, row, 0 * row], axis=1) for row in rows])


@pytest.fixture
def weights(rng):
    return resample(TILES, generator=rng, replicates=1000)


def test_tiles_that_all_agree_leave_the_exact_margin(weights):
    found = difference_interval(stack(6, 3), stack(3), weights)
    assert found.estimate == pytest.approx(0.25)
    assert (found.low, found.high) == (pytest.approx(0.25 - MARGIN), pytest.approx(0.25 + MARGIN))


def test_paired_by_tile(weights, rng):
    lost = rng.integers(0, 5, TILES)
    # One more on every tile: a sixth, for certain as far as resampling sees.
    found = difference_interval(stack(lost + 1), stack(lost), weights)
    assert found.estimate == pytest.approx(1 / 6)
    assert found.high - found.low == pytest.approx(2 * MARGIN)


def test_without_unanimous_series_it_is_the_plain_interval(weights, rng):
    own, other = stack(rng.integers(2, 6, TILES)), stack(rng.integers(0, 4, TILES))
    plain = cluster_interval(np.concatenate([own, other]), success_difference(1), weights)
    found = difference_interval(own, other, weights)
    assert (found.low, found.high) == (pytest.approx(plain.low), pytest.approx(plain.high))
    assert not found.unanimous


def test_a_unanimous_series_adds_its_share(weights, rng):
    own = stack(rng.integers(0, 4, TILES))
    other = stack(6, 6, 6, rng.integers(2, 6, TILES))  # three of four hide every vehicle
    plain = cluster_interval(np.concatenate([own, other]), success_difference(1), weights)
    found = difference_interval(own, other, weights)
    # Their true rate can only be lower, so the difference only higher.
    assert found.low == pytest.approx(plain.low)
    assert found.high - found.estimate == pytest.approx(
        math.hypot(plain.high - plain.estimate, 0.75 * MARGIN)
    )
    assert found.unanimous


def test_undefined_without_vehicles(weights):
    nothing = np.zeros((1, TILES, 3), dtype=np.int64)
    found = difference_interval(nothing, stack(3), weights)
    assert math.isnan(found.estimate)
    assert math.isnan(found.low)


@pytest.mark.parametrize(
    ("own", "other"), [((0.7, 0.5), (0.9, 0.6)), ((0.7, 0.6, 0.5), (0.999, 0.998, 0.8))]
)
def test_holds_the_truth(own, other, weights, rng):
    """Simulated tiles of unlike difficulty, the same for both; 0.95 is meant, 0.92 allows for 200 runs."""
    grid = np.linspace(-5, 5, 1001)
    density = np.exp(-(grid**2) / 2)
    density /= density.sum()

    def chance(rate, difficulty):
        return 1 / (1 + np.exp(-(math.log(rate / (1 - rate)) + 0.8 * difficulty)))

    def expected(rates):
        return np.mean([(density * chance(rate, grid)).sum() for rate in rates])

    truth, held, runs = expected(own) - expected(other), 0, 200
    for _ in range(runs):
        difficulty = rng.normal(size=TILES)
        one, two = (
            stack(*(rng.binomial(VEHICLES, chance(rate, difficulty)) for rate in rates))
            for rates in (own, other)
        )
        found = difference_interval(one, two, resample(TILES, generator=rng, replicates=500))
        held += found.low <= truth <= found.high
    assert held / runs >= 0.92
