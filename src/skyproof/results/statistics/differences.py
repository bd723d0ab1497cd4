"""How far the success rates of two groups of series lie apart, on the same resampled tiles."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from skyproof.results.statistics.intervals import (
    Interval,
    cluster_interval,
    resampled,
    unanimous_margin,
)
from skyproof.results.statistics.rates import overall_attack_success_rate, success_difference

__all__ = ["difference_interval"]


def difference_interval(
    own: Int[np.ndarray, "S C 3"], other: Int[np.ndarray, "T C 3"], weights: Int[np.ndarray, "R C"]
) -> Interval:
    """Mean EASR of some series minus that of others, paired by tile.

    Resampling sees no spread in a series where every tile agrees, such as an attack that hides every vehicle. Each such
    series adds its share of the exact binomial margin (`unanimous_margin`), as if they all erred together.

    Args:
        own, other: pair counts (both, lost, gained) per series and tile.
        weights: from `resample`.
    """
    whole = cluster_interval(np.concatenate([own, other]), success_difference(len(own)), weights)
    if whole.unanimous or math.isnan(whole.low):
        return whole
    own_below, own_above = _hidden_margins(own, weights)
    other_below, other_above = _hidden_margins(other, weights)
    lower = math.hypot(whole.estimate - whole.low, own_below, other_above)
    upper = math.hypot(whole.high - whole.estimate, own_above, other_below)
    return Interval(
        whole.estimate, whole.estimate - lower, whole.estimate + upper, own_below + other_below > 0
    )


def _hidden_margins(
    counts: Int[np.ndarray, "S C 3"], weights: Int[np.ndarray, "R C"]
) -> tuple[float, float]:
    """How far below and above its estimate the mean of the series may lie because of those whose tiles all agree."""
    drawn: Float[np.ndarray, "R S"] = overall_attack_success_rate(resampled(counts, weights))
    agree = np.nanmax(drawn, axis=0) - np.nanmin(drawn, axis=0) < 1e-12
    margin = unanimous_margin(counts.shape[1])
    # No success rate exceeds 1.
    room = 1 - overall_attack_success_rate(counts.sum(axis=1))
    return margin * float(agree.mean()), float(
        np.where(agree, np.minimum(margin, room), 0.0).mean()
    )
