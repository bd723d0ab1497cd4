"""Tests of hypotheses against SciPy's and against cases counted by hand."""

import numpy as np
import pytest
from scipy import stats

from skyproof.results.statistics.contrasts import control_p, holm, mcnemar_p, unchanged_p


@pytest.mark.parametrize(("lost", "gained"), [(0, 0), (1, 0), (5, 5), (12, 3), (3, 12), (60, 2)])
def test_mcnemar_equals_the_exact_binomial_test(lost, gained):
    expected = stats.binomtest(lost, lost + gained, 0.5).pvalue if lost + gained else 1.0
    assert mcnemar_p(lost, gained) == pytest.approx(expected)


def test_what_is_said_of_a_change_holds_for_every_repeat():
    assert unchanged_p(np.array([[0, 12, 3], [0, 60, 2]])) == mcnemar_p(12, 3)
    assert unchanged_p(np.array([[0, 12, 3], [0, 2, 60]])) == 1


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


def test_few_tiles_are_swapped_in_all_ways():
    learnt, drawn = np.array([[3.0, 2.0, 4.0, 1.0, 5.0]]), np.array([[1.0, 1.0, 1.0, 2.0, 1.0]])
    # 2, 1, 3, -1 and 4 make 9, and 11 with the fourth swapped: those two and their opposites, and
    # the two in which the second alone is swapped, or is on the other side: 2 - 1 + 3 + 1 + 4 = 9.
    assert control_p(learnt, drawn) == 6 / 32
    expected = stats.permutation_test(
        (learnt[0], drawn[0]),
        lambda one, other: np.sum(one - other),
        permutation_type="samples",
        n_resamples=np.inf,
    )
    assert control_p(learnt, drawn) == pytest.approx(expected.pvalue)


def test_many_tiles_are_swapped_in_all_ways_too(rng):
    learnt, drawn = rng.integers(0, 4, (1, 60)) + 0.3, rng.integers(0, 4, (1, 60)) + 0.0
    expected = stats.permutation_test(
        (learnt[0], drawn[0]),
        lambda one, other, axis: np.sum(one - other, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=20_000,
        rng=rng,
    )
    assert control_p(learnt, drawn) == pytest.approx(expected.pvalue, abs=0.015)
    # Of a thousand rows that hide more on every tile each is significant after Holm's correction.
    assert control_p(learnt + 4, drawn) == 2 / 2**60
    assert max(holm([control_p(learnt + 4, drawn)] * 1000)) < 0.001


def test_the_share_of_swaps_comes_out_a_little_too_large(rng):
    for _ in range(20):
        hidden = rng.normal(0.4, 1.0, (1, 16)) / 7
        signs = 1 - 2 * ((np.arange(2**16)[:, None] >> np.arange(16)) & 1)
        exact = (np.abs(signs @ hidden[0]) >= hidden.sum() - 1e-12).mean()
        if hidden.sum() > 0:
            assert exact <= control_p(hidden, 0 * hidden) * (1 + 1e-9) <= 1.05 * exact + 1e-12


def test_the_largest_over_repeats_and_draws_counts():
    weak, strong, drawn = [1.0, 1, 1, 0, 0], [1.0, 1, 1, 1, 1], [0.0, 0, 0, 0, 0]
    assert control_p(np.array([weak, strong]), np.array([drawn])) == 2 / 2**3
    # Against a draw that hides more than the weaker seed, nothing can be claimed of every seed.
    better = [1.0, 1, 1, 1, 0]
    assert control_p(np.array([weak, strong]), np.array([drawn, better])) == 1


def test_who_hides_less_than_every_draw_has_shown_nothing(rng):
    learnt, drawn = rng.poisson(1, (1, 60)), rng.poisson(6, (3, 60))
    assert control_p(drawn[:1].astype(float), learnt.astype(float)) < 0.001
    assert control_p(learnt.astype(float), drawn.astype(float)) == 1


def test_where_nothing_differs_p_is_one():
    assert control_p(np.ones((2, 40)), np.ones((3, 40))) == 1


def test_it_is_the_size_that_it_says(rng):
    """Of tests in which it is chance on every tile who hides more, one in twenty is below 5 % for
    either of them, and half of these for the learnt one.
    """
    below = sum(
        control_p(*rng.binomial(6, rng.beta(2, 2, 20), (2, 1, 20)).astype(float)) < 0.05
        for _ in range(1000)
    )
    assert 0.015 < below / 1000 < 0.035
