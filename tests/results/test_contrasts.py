"""Means and differences of success rates are compared with cases worked out by hand.

Simulations say how often the interval holds the truth.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from skyproof.results.statistics import contrasts
from skyproof.results.statistics.contrasts import Group
from skyproof.results.statistics.intervals import (
    Sample,
    cluster_interval,
    overall_attack_success_rate,
)
from skyproof.results.statistics.repeats import DRAWS, GIVEN, SEARCHES, SEEDS, TRAININGS, Repeat

TILES, VEHICLES = 40, 6
MARGIN = 1 - 0.025 ** (1 / TILES)
NUMBERS = np.zeros(1, dtype=np.int64)
# A group whose sample is given later.
ANY = Sample(NUMBERS, NUMBERS, NUMBERS[None])


def stack(*lost, repeats=()):
    """Pair counts of series: of `VEHICLES` found before on every tile, so many are lost."""
    rows = [np.broadcast_to(each, TILES) for each in lost]
    counts = np.array([np.stack([VEHICLES - row, row, 0 * row], axis=1) for row in rows])
    return Group(counts, ANY, repeats)


def mean_interval(group, sample):
    return contrasts.mean_interval(replace(group, sample=sample))


def difference_interval(plus, minus, sample):
    sides = ([replace(group, sample=sample) for group in side] for side in (plus, minus))
    return contrasts.difference_interval(*sides)


def tiles_alone(rng, replicates):
    """The sample of a single vehicle on every tile."""
    cells = [(f"tile-{tile:02d}", "car") for tile in range(TILES)]
    return Sample.draw(cells, generator=rng, replicates=replicates)


@pytest.fixture
def sample(rng):
    return tiles_alone(rng, 1000)


def test_tiles_that_all_agree_leave_the_exact_margins(sample):
    found = difference_interval([stack(6, 3)], [stack(3)], sample)
    assert found.estimate == pytest.approx(0.25)
    # 0.75 and 0.5, each give or take the margin, by the square-and-add rule.
    margin = math.hypot(MARGIN, MARGIN)
    assert (found.low, found.high) == (pytest.approx(0.25 - margin), pytest.approx(0.25 + margin))


def test_paired_by_tile(sample, rng):
    lost = rng.integers(0, 5, TILES)
    # One more on every tile: a sixth, for certain as far as resampling sees.
    found = difference_interval([stack(lost + 1)], [stack(lost)], sample)
    assert found.estimate == pytest.approx(1 / 6)
    assert found.high - found.low == pytest.approx(2 * MARGIN)


def test_without_unanimous_series_it_is_nearly_the_plain_interval(sample, rng):
    own = stack(rng.integers(2, 6, TILES))
    other = stack(rng.integers(0, 4, TILES))

    def minus(counts):
        easr = overall_attack_success_rate(counts)
        return easr[..., 0] - easr[..., 1]

    plain = cluster_interval(np.concatenate([own.counts, other.counts]), minus, sample.weights)
    found = difference_interval([own], [other], sample)
    assert found.low == pytest.approx(plain.low, abs=0.005)
    assert found.high == pytest.approx(plain.high, abs=0.005)
    assert not found.unanimous


def test_likes_are_no_surer_apart_than_together(sample, rng):
    """Of what two have in common nothing is left in their difference, whatever their own limits."""
    lost = rng.integers(0, 4, TILES)
    odd = (np.arange(TILES) % 2 == 0).astype(int)
    found = difference_interval([stack(lost + odd)], [stack(lost)], sample)
    own = mean_interval(stack(lost + odd), sample)
    assert found.high - found.low < 0.75 * (own.high - own.low)


def test_near_one_a_difference_is_as_sure_as_below_and_above(sample, rng):
    """A control finds as many vehicles anew as it hides, so that a net rate may be 1 or more."""
    own = stack(np.where(np.arange(TILES) < 2, 5, 6))
    widths = []
    for gained in np.linspace(0.0, 0.6, 7):
        control = stack(rng.integers(0, 2, TILES))
        control.counts[0, :, 2] = rng.random(TILES) < 0.5 + gained
        found = difference_interval([own], [control], sample)
        assert 0.95 < found.estimate < 1.1
        widths.append(found.estimate - found.low)
    assert max(widths) < 2 * min(widths)
    assert max(widths) < 0.1


def test_a_unanimous_group_enters_with_its_exact_limits(sample, rng):
    own = stack(rng.integers(0, 4, TILES))
    hidden = stack(6)  # every vehicle, so its true rate can only be lower
    part = mean_interval(own, sample)
    found = difference_interval([own], [hidden], sample)
    assert found.unanimous
    assert found.high - found.estimate == pytest.approx(
        math.hypot(part.high - part.estimate, MARGIN)
    )
    assert found.low == pytest.approx(found.estimate - (part.estimate - part.low), abs=0.01)


def test_a_difference_of_differences(sample, rng):
    """What is 0.5 above its control here and 0.2 above it there lost 0.3, of whatever is shared."""
    lost = rng.integers(0, 3, TILES)
    found = difference_interval(
        [stack(lost + 1), stack(lost)], [stack(lost + 3), stack(lost)], sample
    )
    assert found.estimate == pytest.approx(-2 / 6)
    # The tiles' differences are the same everywhere, as far as resampling sees.
    assert found.high - found.low == pytest.approx(2 * MARGIN)


def test_undefined_without_vehicles(sample):
    nothing = Group(np.zeros((1, TILES, 3), dtype=np.int64), ANY)
    found = difference_interval([nothing], [stack(3)], sample)
    assert math.isnan(found.estimate)
    assert math.isnan(found.low)


@pytest.mark.parametrize(
    ("own", "other"), [((0.7, 0.5), (0.9, 0.6)), ((0.7, 0.6, 0.5), (0.999, 0.998, 0.8))]
)
def test_holds_the_truth(own, other, rng):
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
        found = difference_interval([one], [two], tiles_alone(rng, 500))
        held += found.low <= truth <= found.high
    assert held / runs >= 0.92


def labels(of, kind, count, detectors=1):
    return [[Repeat(of, str(number), kind)] for number in range(count) for _ in range(detectors)]


def test_repeats_by_hand(sample, rng):
    lost = rng.integers(1, 4, TILES)
    alone = mean_interval(stack(lost, lost, lost + 1, lost + 1, lost + 2, lost + 2), sample)
    seeds = stack(
        *(lost, lost, lost + 1, lost + 1, lost + 2, lost + 2), repeats=labels("T-U", SEEDS, 3, 2)
    )
    found = mean_interval(seeds, sample)
    # Rates a sixth apart: three of them, two degrees.
    assert found.errors == alone.errors | {"seeds": pytest.approx(1 / 6 / 3**0.5)}
    margin = 4.302653 / 6 / 3**0.5
    assert found.high - found.estimate == pytest.approx(
        math.hypot(alone.high - alone.estimate, margin)
    )
    assert found.estimate - found.low == pytest.approx(
        math.hypot(alone.estimate - alone.low, margin)
    )


def test_repeats_that_agree_do_not_pass_for_certain(sample, rng):
    lost = rng.integers(1, 4, TILES)
    alone = mean_interval(stack(lost), sample)
    found = mean_interval(stack(lost, lost, lost, repeats=labels("T-U", SEEDS, 3)), sample)
    margin = 3.182446 * SEEDS.usual_sd / 3**0.5
    assert found.high - found.estimate == pytest.approx(
        math.hypot(alone.high - alone.estimate, margin)
    )


@pytest.mark.parametrize("kind", [SEEDS, DRAWS, SEARCHES, TRAININGS])
def test_a_single_repeat_is_no_surer_than_three(kind, sample, rng):
    """It is off by as much as the largest spread that was measured."""
    lost = rng.integers(1, 4, TILES)
    more = lost + (np.arange(TILES) % 4 == 0)
    alone = mean_interval(stack(lost), sample)
    found = mean_interval(stack(lost, repeats=labels("T-U", kind, 1)), sample)
    assert found.high - found.estimate == pytest.approx(
        math.hypot(alone.high - alone.estimate, 1.959964 * kind.largest_sd)
    )
    assert found.errors[kind.name] == kind.largest_sd
    three = mean_interval(stack(lost, lost, more, repeats=labels("T-U", kind, 3)), sample)
    assert three.high - three.low <= found.high - found.low + 0.01
    given = mean_interval(stack(lost, repeats=labels("mine", GIVEN, 1)), sample)
    assert given == alone


def test_one_search_is_not_taken_as_known(sample, rng):
    """Nor are several: what is due to optimisation must stand out from their spread."""
    lost = rng.integers(0, 2, TILES)
    learnt = stack(lost + 4, lost + 4, lost + 4, repeats=labels("T-U", SEEDS, 3))
    known = difference_interval([learnt], [stack(lost)], sample)
    one = difference_interval(
        [learnt], [stack(lost, repeats=labels("R-U_search", SEARCHES, 1))], sample
    )
    five = difference_interval(
        [learnt],
        [stack(lost, lost + 1, lost, lost + 1, lost, repeats=labels("R-U_search", SEARCHES, 5))],
        sample,
    )
    below = math.hypot(known.estimate - known.low, 1.959964 * SEARCHES.largest_sd)
    assert one.estimate - one.low == pytest.approx(below)
    assert one.errors["searches"] == SEARCHES.largest_sd
    # Two of five a sixth higher: a standard deviation of 0.091, but pairs usually differ more.
    assert five.errors["searches"] == pytest.approx(SEARCHES.usual_sd / 5**0.5)
    assert one.low < five.low


def test_a_difference_has_the_repeats_of_both_sides(sample, rng):
    lost = rng.integers(2, 4, TILES)
    own = stack(lost + 1, lost + 2, lost + 3, repeats=labels("T-U", SEEDS, 3))
    other = stack(lost, lost - 2, repeats=labels("R-U", DRAWS, 2))
    plain = difference_interval([Group(own.counts, ANY)], [Group(other.counts, ANY)], sample)
    found = difference_interval([own], [other], sample)
    assert found.errors["seeds"] == pytest.approx(1 / 6 / 3**0.5)
    assert found.errors["draws"] == pytest.approx(2 / 6 / 2**0.5 / 2**0.5)
    # Of the draws the mean may be anything from 0 on, and 1.96 times the largest standard
    # deviation of a kind higher. That of the seeds has two degrees, and is at most 1.
    drawn = (lost.mean() - 1) / 6
    learnt = (lost.mean() + 2) / 6
    of_seeds, of_draws = 4.302653 / 6 / 3**0.5, 1.959964 * DRAWS.largest_sd
    assert found.high - found.estimate == pytest.approx(
        math.hypot(plain.high - plain.estimate, min(of_seeds, 1 - learnt), min(of_draws, drawn))
    )
    assert found.estimate - found.low == pytest.approx(
        math.hypot(plain.estimate - plain.low, min(of_seeds, learnt), min(of_draws, 1 - drawn))
    )


def test_what_repeats_share_is_paired(sample, rng):
    """Two renderers that show the same seeds differ by as much for each: the seeds add little."""
    lost = rng.integers(1, 3, TILES)
    seeds = labels("T-U", SEEDS, 3)
    first = stack(lost, lost + 1, lost + 3, repeats=seeds)
    second = stack(lost + 1, lost + 2, lost + 4, repeats=seeds)
    paired = difference_interval([second], [first], sample)
    assert paired.errors["seeds"] == pytest.approx(SEEDS.usual_sd / 3**0.5)
    draws = labels("R-U", DRAWS, 3)
    first, second = (Group(each.counts, ANY, draws) for each in (first, second))
    found = difference_interval([second], [first], sample)
    # A draw acts much alike under two renderers.
    assert found.errors["seeds"] == paired.errors["seeds"]
    first, second = (Group(each.counts, ANY, seeds) for each in (first, second))
    # The same shuffled is not the same.
    other = stack(lost + 4, lost + 2, lost + 1, repeats=seeds)
    assert difference_interval([other], [first], sample).errors["seeds"] > 0.1


def trained(*own):
    """Which training each series is before, and which draw of a control where it is one."""
    return [
        [Repeat("detectors", str(training), TRAININGS)]
        + ([] if draw is None else [Repeat("R-U", str(draw), DRAWS)])
        for training, draw in own
    ]


def test_trainings_by_hand(sample, rng):
    lost = rng.integers(1, 4, TILES)
    rates = (lost, lost + 1, lost + 2)
    plain = mean_interval(stack(*rates), sample)
    found = mean_interval(stack(*rates, repeats=trained((0, None), (1, None), (2, None))), sample)
    # Rates a sixth apart, less than the largest standard deviation that was measured.
    assert found.errors == plain.errors | {"trainings": pytest.approx(1 / 6 / 3**0.5)}
    assert found.high - found.estimate == pytest.approx(
        math.hypot(plain.high - plain.estimate, 1.959964 * TRAININGS.largest_sd)
    )


def test_draws_are_crossed_with_trainings(sample, rng):
    """A control's draw is one for all trainings, and a training one for all draws."""
    lost = rng.integers(1, 3, TILES)
    places = [(training, draw) for training in range(2) for draw in range(2)]
    control = stack(
        *(lost + 2 * draw + training for training, draw in places), repeats=trained(*places)
    )
    plain = mean_interval(Group(control.counts, ANY), sample)
    found = mean_interval(control, sample)
    # Draws lie two sixths apart and trainings one, each about a mean of two.
    assert found.errors == plain.errors | {
        "draws": pytest.approx(2 / 6 / 2),
        "trainings": pytest.approx(1 / 6 / 2),
    }


def test_a_net_rate_is_paired_by_training(sample, rng):
    """Detectors that lose more to everything leave the net rate as it is."""
    lost = rng.integers(0, 2, TILES)
    learnt = stack(lost + 2, lost + 3, lost + 4, repeats=trained((0, None), (1, None), (2, None)))
    control = stack(lost, lost + 1, lost + 2, repeats=trained((0, 0), (1, 0), (2, 0)))
    found = difference_interval([learnt], [control], sample)
    assert found.errors["trainings"] == pytest.approx(TRAININGS.usual_sd / 3**0.5)
    # A single draw.
    assert found.errors["draws"] == DRAWS.largest_sd
    # The same trainings in another order lie far apart.
    other = stack(lost + 4, lost + 3, lost + 2, repeats=learnt.repeats)
    found = difference_interval([other], [control], sample)
    assert found.errors["trainings"] == pytest.approx(2 / 6 / 3**0.5)


def test_one_group_may_have_repeats_and_another_none(sample, rng):
    lost = rng.integers(0, 2, TILES)
    seeds = stack(lost + 1, lost + 2, repeats=labels("T-U", SEEDS, 2))
    found = difference_interval([stack(lost)], [seeds], sample)
    assert found.errors["seeds"] == pytest.approx(1 / 6 / 2)


def test_vehicles_that_fare_alike_on_every_tile_widen_the_interval(rng):
    """Of eight vehicles on 40 tiles four are always lost: eight observations, not 320."""
    cells = [(f"tile-{tile:02d}", f"car-{car}") for tile in range(TILES) for car in range(8)]
    sample = Sample.draw(cells, generator=rng)
    lost = sample.vehicle % 2
    # Tiles differ a little, too.
    lost[(sample.tile % 5 == 0) & (sample.vehicle == 0)] = 1
    counts = np.stack([1 - lost, lost, 0 * lost], axis=1)[None]
    found = mean_interval(Group(counts, ANY), sample)
    assert found.errors["vehicles"] == pytest.approx((0.25 / 7) ** 0.5, rel=0.1)
    assert found.errors["tiles"] < 0.01
    # Student's quantile of 7 degrees for a mean of 8 observations is 0.45; those of rates are less.
    assert 0.35 < found.high - found.estimate < 0.47
    # Against another camouflage that loses the same vehicles they play no part.
    same = difference_interval([Group(counts, ANY)], [Group(counts, ANY)], sample)
    assert same.errors["vehicles"] == pytest.approx(0)


def test_where_all_agree_the_fewer_of_tiles_and_vehicles_count(rng):
    cells = [(f"tile-{tile:02d}", f"car-{car}") for tile in range(TILES) for car in range(8)]
    sample = Sample.draw(cells, generator=rng)
    found = mean_interval(Group(np.tile([0, 1, 0], (1, len(cells), 1)), ANY), sample)
    assert (found.low, found.high) == (pytest.approx(0.025 ** (1 / 8)), 1.0)
