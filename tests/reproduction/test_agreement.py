"""Rank correlation with the paper, against SciPy's."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from skyproof.reproduction.agreement import (
    correlated,
    rank_correlations,
    successes,
    with_paper,
)
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.results.outcomes import OutcomeCounts, Series
from skyproof.results.results import Results
from skyproof.results.stored import RunConfig
from tests.results.counted import on_tiles

PAPER = {name: result.easr for name, result in PAPER_RESULTS.items()}


def counted(lost_of_hundred, rng=None, tiles=40, renderer="torch"):
    """Makes per camouflage `tiles` tiles of 100 vehicles that lose so many.

    With `rng` the tiles differ.
    """
    series = {}
    for name, lost in lost_of_hundred.items():
        gone = (
            np.full(tiles, lost)
            if rng is None
            else rng.binomial(100, rng.beta(lost / 50, 2 - lost / 50, tiles))
        )
        counts = np.stack([np.full(tiles, 100), 100 - gone, gone, 0 * gone], axis=1)
        series[Series(name, renderer, "a", "centre_1m")] = counts
    return on_tiles([f"t{i:02d}" for i in range(tiles)], series)


OURS = {
    "T-U-0": 99,
    "T-U-1": 97,
    "T-Ma": 60,
    "T-Fc": 70,
    "R-U-0": 3,
    "S-O@0.4-0": 80,
    "T-FcMa": 3,
    "T-U_on_a": 5,
}


def beside_the_paper(tiles, paper=PAPER, rows=None, renderer="torch"):
    """The row of all attacks."""
    rows = with_paper(results_of(tiles), "compared", paper, rows or {}, renderer)
    return next((row for row in rows if row["set"] == "all, with random controls"), None)


def between_renderers(tiles, names):
    results = results_of(tiles)
    orders = [successes(results, names, each, paired=True) for each in ("torch", "cycles")]
    return correlated("compared", "all", names, *orders)


def results_of(tiles):
    return Results(Path(), [], [], tiles, [], RunConfig(), {}, [], {}, {}, {})


def is_that_of_scipy(row, ours, theirs):
    assert row["attacks"] == len(ours)
    assert row["spearman"] == pytest.approx(stats.spearmanr(ours, theirs).statistic)
    assert row["kendall"] == pytest.approx(stats.kendalltau(ours, theirs).statistic)


def test_correlations_are_those_of_scipy():
    row = beside_the_paper(counted(OURS), rows={"S-O": "S-O@0.4"})
    # T-U, S-O, T-Ma, T-Fc, T-FcMa, R-U.
    theirs = [95.77, 89.82, 75.76, 37.22, 12.58, 0.88]
    is_that_of_scipy(row, [0.98, 0.8, 0.6, 0.7, 0.03, 0.03], theirs)
    # Tiles that are all alike leave the order as it is.
    assert row["spearman_low"] == pytest.approx(row["spearman_high"])
    # A combination without a shape is its texture, and counts as that alone.
    best = {"S-O": "S-O@0.4", "C-Fc-seq": "T-Fc", "C-Fc-par": "T-Fc"}
    assert beside_the_paper(counted(OURS), rows=best) == row


def test_many_orders_at_once_are_each_that_of_scipy(rng):
    # Of few values, so that some are tied; and all of one row.
    one, other = rng.integers(0, 4, (2, 30, 6)).astype(float)
    one[7] = 2.0
    spearman, kendall = rank_correlations(one, other)
    assert np.isnan(spearman[7])
    assert np.isnan(kendall[7])
    for row in set(range(30)) - {7}:
        ours, theirs = one[row], other[row]
        assert spearman[row] == pytest.approx(stats.spearmanr(ours, theirs).statistic)
        assert kendall[row] == pytest.approx(stats.kendalltau(ours, theirs).statistic)


def test_tiles_that_differ_leave_the_order_open(rng):
    row = beside_the_paper(counted(OURS, rng))
    assert row["spearman_low"] <= row["spearman"] <= row["spearman_high"] <= 1
    assert row["spearman_low"] < row["spearman_high"]
    assert row["kendall_low"] < row["kendall_high"] <= 1


def test_the_reverse_order():
    row = beside_the_paper(counted({"T-U": 1, "T-Ma": 2, "T-Fc": 3}))
    assert (row["spearman"], row["kendall"]) == (pytest.approx(-1), pytest.approx(-1))


def test_two_renderers():
    ours, other = (
        counted(OURS),
        counted({"T-U-0": 60, "T-U-1": 40, "T-Ma": 70, "T-Fc": 20, "T-X": 5}, renderer="cycles"),
    )
    alone = counted({"T-U-2": 0}).series  # a repeat that only one of them has does not count
    both = OutcomeCounts(ours.cells, {**ours.series, **other.series, **alone})
    (row,) = between_renderers(both, ["T-U", "T-Fc", "T-Ma", "T-X", "R-U"])
    # T-X and R-U are on one of them only.
    is_that_of_scipy(row, [0.98, 0.7, 0.6], [0.5, 0.2, 0.7])
    paired = successes(results_of(both), ["T-U"], "torch", paired=True)
    assert paired["T-U"][0] == pytest.approx(0.98)
    # The paper's Blender column beside ours on Cycles alone.
    paper = {"T-U": 3.0, "T-Ma": 2.0, "T-Fc": 1.0}
    is_that_of_scipy(
        beside_the_paper(both, paper, renderer="cycles"), [0.5, 0.7, 0.2], [3.0, 2.0, 1.0]
    )
    assert between_renderers(both, ["T-U", "T-Fc", "T-X"]) == []


def test_two_renderers_of_unlike_tiles_leave_the_order_open(rng):
    ours = counted(OURS, rng)
    other = counted({"T-U-0": 55, "T-Ma": 50, "T-Fc": 45}, rng, renderer="cycles")
    both = OutcomeCounts(ours.cells, {**ours.series, **other.series})
    names = ["T-U", "T-Ma", "T-Fc"]
    (row,) = between_renderers(both, names)
    assert -1 <= row["spearman_low"] < row["spearman_high"] <= 1
    theirs = successes(results_of(both), names, "cycles", paired=True)
    fixed = beside_the_paper(both, {name: easr[0] for name, easr in theirs.items()})
    # Both move here, only one there.
    width = row["spearman_high"] - row["spearman_low"]
    assert width >= fixed["spearman_high"] - fixed["spearman_low"]


def test_too_few_are_not_compared():
    assert beside_the_paper(counted({"T-U": 50, "T-Ma": 20, "T-X": 20})) is None


def test_the_papers_table():
    assert len(PAPER_RESULTS) == 25
    assert PAPER_RESULTS["T-U"].easr == 95.77
    assert PAPER_RESULTS["C-PixFc-par"].easr_blender == 77.86
    assert {name for name, result in PAPER_RESULTS.items() if result.easr_blender is None} == {
        "C-U-seq",
        "C-Pix-seq",
        "C-Lc-seq",
        "C-PixLc-seq",
    }
    assert {r.perturbation_magnitude for r in PAPER_RESULTS.values()} == {None, 0.0, 0.2, 0.4}
