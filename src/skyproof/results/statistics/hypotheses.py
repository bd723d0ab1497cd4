"""Two tests of a camouflage: that it changes anything, and that it hides more than its control.

The first is McNemar's exact test against no camouflage, which random patterns can pass as well. The
second is a permutation test against each draw of the random control, on the same vehicles.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

_EXACT_TILES = 12
_FLIPS = 10_000


def unchanged_p(totals: Int[np.ndarray, "repeats 3"]) -> float:
    """Gives the largest of the repeats' McNemar p-values; 1 where they point both ways."""
    balance = totals[:, 1] - totals[:, 2]
    if balance.min() < 0 < balance.max():
        return 1.0
    return max(mcnemar_p(int(lost), int(gained)) for _, lost, gained in totals)


def mcnemar_p(lost: int, gained: int) -> float:
    """Gives the p-value of McNemar's two-sided exact test, from the discordant pairs.

    Its hypothesis is that as many vehicles are lost as gained. Vehicles count as independent here;
    trust the interval more where a tile holds many of them.
    """
    discordant = lost + gained
    if not discordant:
        return 1.0
    return min(1.0, 2 * float(stats.binom.cdf(min(lost, gained), discordant, 0.5)))


def control_p(
    optimised: Float[np.ndarray, "repeats C"], drawn: Float[np.ndarray, "draws C"]
) -> float:
    """Gives the largest p of optimised camouflages against draws of their control, in all pairs.

    The hypothesis is that chance decides on each tile which of the two hides more. So optimised and
    drawn are swapped tile by tile: in all ways for up to 12 tiles on which they differ, else in
    10,000 random ones, the same in every call. p is the share of swaps, the observed one included,
    after which the sums differ by as much, in either direction. It is 1 unless the optimised one
    hides more in every pair. Tiles count as independent. Given are vehicles lost minus vehicles
    gained per tile, summed over detectors, each divided by the vehicles that it found before.
    """
    differences = (optimised[:, None] - drawn[None]).reshape(-1, optimised.shape[1])
    sums = differences.sum(axis=1)
    # Sums of fractions that are equal may differ by rounding.
    slack = 1e-9 * max(float(np.abs(differences).sum(axis=1).max()), 1e-300)
    if not sums.min() > slack:
        return 1.0
    telling = differences[:, np.any(np.abs(differences) > slack, axis=0)]
    tiles = telling.shape[1]
    if tiles <= _EXACT_TILES:
        signs = 1.0 - 2.0 * ((np.arange(2**tiles)[:, None] >> np.arange(tiles)) & 1)
        observed = 0
    else:
        signs = 1.0 - 2.0 * np.random.default_rng(0).integers(0, 2, (_FLIPS, tiles))
        observed = 1
    swapped = np.abs(signs @ telling.T)
    as_far = (swapped >= np.abs(sums) - slack).sum(axis=0) + observed
    return float(as_far.max() / (len(signs) + observed))


def holm(p_values: Sequence[float]) -> list[float]:
    """Applies Holm's step-down correction over one family of tests; the order stays as given."""
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        # A later p-value may not come out smaller than an earlier one.
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected
