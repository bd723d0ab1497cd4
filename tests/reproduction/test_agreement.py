"""Rank correlation with the paper, against SciPy's."""

import numpy as np
import pytest
from scipy import stats

from skyproof.reproduction.agreement import rank_agreement, rank_correlations, renderer_agreement
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.results.pairs.counts import OutcomeCounts, Series
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


def test_correlations_are_those_of_scipy():
    found = rank_agreement(counted(OURS), PAPER, rows={"S-O": "S-O@0.4"})
    assert found.attacks == ["T-U", "S-O", "T-Ma", "T-Fc", "T-FcMa", "R-U"]
    assert found.ours == pytest.approx([0.98, 0.8, 0.6, 0.7, 0.03, 0.03])
    assert found.theirs == [95.77, 89.82, 75.76, 37.22, 12.58, 0.88]
    assert found.spearman.estimate == pytest.approx(
        stats.spearmanr(found.ours, found.theirs).statistic
    )
    assert found.kendall.estimate == pytest.approx(
        stats.kendalltau(found.ours, found.theirs).statistic
    )
    # Tiles that are all alike leave the order as it is.
    assert found.spearman.low == pytest.approx(found.spearman.high)
    # A combination without a shape is its texture, and counts as that alone.
    best = {"S-O": "S-O@0.4", "C-Fc-seq": "T-Fc", "C-Fc-par": "T-Fc"}
    assert rank_agreement(counted(OURS), PAPER, rows=best).attacks == found.attacks


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
    found = rank_agreement(counted(OURS, rng), PAPER)
    assert found.spearman.low <= found.spearman.estimate <= found.spearman.high <= 1
    assert found.spearman.low < found.spearman.high
    assert found.kendall.low < found.kendall.high <= 1


def test_the_reverse_order():
    found = rank_agreement(counted({"T-U": 1, "T-Ma": 2, "T-Fc": 3}), PAPER)
    assert (found.spearman.estimate, found.kendall.estimate) == (
        pytest.approx(-1),
        pytest.approx(-1),
    )


def test_two_renderers():
    ours, other = (
        counted(OURS),
        counted({"T-U-0": 60, "T-U-1": 40, "T-Ma": 70, "T-Fc": 20, "T-X": 5}, renderer="cycles"),
    )
    alone = counted({"T-U-2": 0}).series  # a repeat that only one of them has does not count
    both = OutcomeCounts(ours.cells, {**ours.series, **other.series, **alone})
    found = renderer_agreement(both, ["T-U", "T-Fc", "T-Ma", "T-X", "R-U"])
    # T-X and R-U are on one of them only.
    assert found.attacks == ["T-Ma", "T-U", "T-Fc"]
    assert found.ours == pytest.approx([0.6, 0.98, 0.7])
    assert found.theirs == pytest.approx([0.7, 0.5, 0.2])
    assert found.spearman.estimate == pytest.approx(
        stats.spearmanr(found.ours, found.theirs).statistic
    )
    assert found.kendall.estimate == pytest.approx(
        stats.kendalltau(found.ours, found.theirs).statistic
    )
    # The paper's Blender column beside ours on Cycles alone.
    blender = rank_agreement(both, {"T-U": 3.0, "T-Ma": 2.0, "T-Fc": 1.0}, renderer="cycles")
    assert blender.ours == pytest.approx([0.5, 0.7, 0.2])
    assert renderer_agreement(both, ["T-U", "T-Fc", "T-X"]) is None


def test_two_renderers_of_unlike_tiles_leave_the_order_open(rng):
    ours = counted(OURS, rng)
    other = counted({"T-U-0": 55, "T-Ma": 50, "T-Fc": 45}, rng, renderer="cycles")
    both = OutcomeCounts(ours.cells, {**ours.series, **other.series})
    found = renderer_agreement(both, ["T-U", "T-Ma", "T-Fc"])
    assert -1 <= found.spearman.low < found.spearman.high <= 1
    fixed = rank_agreement(
        both, dict(zip(found.attacks, found.theirs, strict=True)), renderer="torch"
    )
    # Both move here, only one there.
    assert found.spearman.high - found.spearman.low >= fixed.spearman.high - fixed.spearman.low


def test_too_few_are_not_compared():
    assert rank_agreement(counted({"T-U": 50, "T-Ma": 20, "T-X": 20}), PAPER) is None


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
