"""Differences of success rates are compared with cases worked out by hand.

Simulations say how often the interval holds the truth.
"""

import math

import numpy as np
import pytest

from skyproof.results.statistics.differences import difference_interval
from skyproof.results.statistics.intervals import cluster_interval, mean_interval, resample
from skyproof.results.statistics.rates import overall_attack_success_rate

TILES, VEHICLES = 40, 6
MARGIN = 1 - 0.025 ** (1 / TILES)


def stack(*lost):
    """Pair counts of series: of `VEHICLES` found before on every tile, so many are lost."""
    rows = [np.broadcast_to(each, TILES) for each in lost]
    return np.array([np.stack([VEHICLES - row, row, 0 * row], axis=1) for row in rows])


@pytest.fixture
def weights(rng):
    return resample(TILES, generator=rng, replicates=1000)


def test_tiles_that_all_agree_leave_the_exact_margins(weights):
    found = difference_interval([stack(6, 3)], [stack(3)], weights)
    assert found.estimate == pytest.approx(0.25)
    # 0.75 and 0.5, each give or take the margin, by the square-and-add rule.
    margin = math.hypot(MARGIN, MARGIN)
    assert (found.low, found.high) == (pytest.approx(0.25 - margin), pytest.approx(0.25 + margin))


def test_paired_by_tile(weights, rng):
    lost = rng.integers(0, 5, TILES)
    # One more on every tile: a sixth, for certain as far as resampling sees.
    found = difference_interval([stack(lost + 1)], [stack(lost)], weights)
    assert found.estimate == pytest.approx(1 / 6)
    assert found.high - found.low == pytest.approx(2 * MARGIN)


def test_without_unanimous_series_it_is_the_plain_interval(weights, rng):
    own = stack(rng.integers(2, 6, TILES))
    other = stack(rng.integers(0, 4, TILES))

    def minus(counts):
        easr = overall_attack_success_rate(counts)
        return easr[..., 0] - easr[..., 1]

    plain = cluster_interval(np.concatenate([own, other]), minus, weights)
    found = difference_interval([own], [other], weights)
    assert (found.low, found.high) == (pytest.approx(plain.low), pytest.approx(plain.high))
    assert not found.unanimous


def test_a_unanimous_group_enters_with_its_exact_limits(weights, rng):
    own = stack(rng.integers(0, 4, TILES))
    hidden = stack(6)  # every vehicle, so its true rate can only be lower
    part = mean_interval(own, overall_attack_success_rate, weights, (-math.inf, 1.0))
    found = difference_interval([own], [hidden], weights)
    assert found.unanimous
    assert found.high - found.estimate == pytest.approx(
        math.hypot(part.high - part.estimate, MARGIN)
    )
    assert found.low == pytest.approx(found.estimate - (part.estimate - part.low), abs=0.01)


def test_a_difference_of_differences(weights, rng):
    """What is 0.5 above its control here and 0.2 above it there lost 0.3, of whatever is shared."""
    lost = rng.integers(0, 3, TILES)
    found = difference_interval(
        [stack(lost + 1), stack(lost)], [stack(lost + 3), stack(lost)], weights
    )
    assert found.estimate == pytest.approx(-2 / 6)
    # The tiles' differences are the same everywhere, as far as resampling sees.
    assert found.high - found.low == pytest.approx(2 * MARGIN)


def test_undefined_without_vehicles(weights):
    nothing = np.zeros((1, TILES, 3), dtype=np.int64)
    found = difference_interval([nothing], [stack(3)], weights)
    assert math.isnan(found.estimate)
    assert math.isnan(found.low)


@pytest.mark.parametrize(
    ("own", "other"), [((0.7, 0.5), (0.9, 0.6)), ((0.7, 0.6, 0.5), (0.999, 0.998, 0.8))]
)
def test_holds_the_truth(own, other, weights, rng):
    """Simulated tiles are of unlike difficulty, the same for both.

    A share of 0.95 is meant; 0.92 allows for 200 runs.
    """
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
        found = difference_interval([one], [two], resample(TILES, generator=rng, replicates=500))
        held += found.low <= truth <= found.high
    assert held / runs >= 0.92
