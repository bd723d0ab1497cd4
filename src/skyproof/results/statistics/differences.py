"""How far success rates of groups of series lie apart, on the same resampled tiles.

This is the one way by which the interval of any difference is found: what optimisation adds to a
random control, one renderer against another, a later step of an attack against an earlier one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int, Num

from skyproof.results.statistics.intervals import Interval, cluster_interval, mean_interval
from skyproof.results.statistics.rates import overall_attack_success_rate

__all__ = ["difference_interval"]


def difference_interval(
    plus: Sequence[Int[np.ndarray, "_ C 3"]],
    minus: Sequence[Int[np.ndarray, "_ C 3"]],
    weights: Int[np.ndarray, "R C"],
) -> Interval:
    """Gives the sum of some groups' mean EASRs minus that of others, paired by tile.

    Resampling sees no spread in a series where every tile agrees, such as an attack that hides
    every vehicle. Where a group has such a series, the groups' own exact limits enter by the
    square-and-add rule for differences of independent rates (MOVER; Zou and Donner 2008), and the
    farther limits count.

    Args:
        plus, minus: groups of series; a group's EASR is the unweighted mean over its series, given
            as pair counts (both, lost, gained) per series and tile.
        weights: resampled tiles, from `resample`.
    """
    groups = [*plus, *minus]
    statistic = _difference([len(group) for group in groups], len(plus))
    whole = cluster_interval(np.concatenate(groups), statistic, weights)
    parts = [
        mean_interval(group, overall_attack_success_rate, weights, (-math.inf, 1.0))
        for group in groups
    ]
    below = [part.estimate - part.low for part in parts]
    above = [part.high - part.estimate for part in parts]
    count = len(plus)
    lower = math.hypot(*below[:count], *above[count:])
    upper = math.hypot(*above[:count], *below[count:])
    unanimous = any(part.unanimous for part in parts)
    if not unanimous or math.isnan(lower + upper):
        return whole
    return Interval(
        whole.estimate,
        min(whole.low, whole.estimate - lower),
        max(whole.high, whole.estimate + upper),
        unanimous=True,
    )


def _difference(
    sizes: Sequence[int], plus: int
) -> Callable[[Num[np.ndarray, "*shape S 3"]], Float[np.ndarray, "*shape"]]:
    """Gives the statistic of stacked groups of these sizes, of which the first `plus` are added."""
    ends = np.cumsum(sizes)

    def difference(counts: Num[np.ndarray, "*shape S 3"]) -> Float[np.ndarray, "*shape"]:
        easr = overall_attack_success_rate(counts)
        means = [
            easr[..., end - size : end].mean(axis=-1) for end, size in zip(ends, sizes, strict=True)
        ]
        total = means[0]
        for number, mean in enumerate(means[1:], start=1):
            total = total + mean if number < plus else total - mean
        return np.asarray(total)

    return difference
