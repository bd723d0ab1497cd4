"""How sure a success rate is: its interval, McNemar's exact test and Holm's correction.

Vehicles on one background tile share ground, light and neighbours, so they are not independent:
the bootstrap resamples tiles, not vehicles. All detectors and camouflages see the same resampled
tiles, which is what makes differences between them (net EASR, means over detectors) as sure as the
pairing allows.

Differences from the paper: it gives no intervals. Either limit is the farther of two: BCa's, at
levels widened for few clusters, and the exact binomial one at the effective number of vehicles. In
simulations (`tests/results/test_intervals.py`) BCa alone held the truth in 90-95 % of runs, least
where nearly all vehicles of unlike tiles are lost. Both together hold it in at least 93 %, mostly
in 95-97 %, and are 6-13 % wider; up to 45 % where few tiles decide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Num
from scipy import special, stats

__all__ = [
    "REPLICATES",
    "Interval",
    "bootstrap_interval",
    "cluster_interval",
    "effective_limits",
    "holm",
    "mcnemar_p",
    "mean_interval",
    "resample",
    "resampled",
    "unanimous_margin",
]

REPLICATES = 2000
_TAIL = 0.025


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % limits.

    What is undefined is nan: no vehicle was found before, or there are fewer than two tiles.
    `unanimous` says that every tile agreed in some part, so that exact binomial limits entered.
    """

    estimate: float
    low: float
    high: float
    unanimous: bool = False


def resample(
    clusters: int, *, generator: np.random.Generator, replicates: int = REPLICATES
) -> Int[np.ndarray, "R C"]:
    """Draws how often each cluster occurs in each bootstrap replicate, with replacement.

    One draw serves all rows of a table.

    Returns:
        `[replicates, clusters]`; every row sums to `clusters`.
    """
    return generator.multinomial(clusters, np.full(clusters, 1 / clusters), size=replicates)


def cluster_interval(
    counts: Num[np.ndarray, "S C 3"],
    statistic: Callable[[np.ndarray], np.ndarray],
    weights: Int[np.ndarray, "R C"],
    *,
    limits: tuple[float, float] = (-math.inf, math.inf),
) -> Interval:
    """Gives the 95 % cluster-bootstrap interval of any statistic of summed pair counts.

    It is bias-corrected and accelerated (BCa; Efron 1987), with the acceleration from leaving out
    one cluster at a time. The normal quantile is replaced by Student's with C − 1 degrees of
    freedom times sqrt(C / (C − 1)) (Hesterberg 2015), because resampling C clusters understates
    their spread by that factor. Each limit is moved out to Korn and Graubard's (1998) where that is
    farther: the exact binomial limit at the effective number of vehicles, see `effective_limits`.
    Replicates in which the statistic is undefined are left out. Where all replicates agree (nothing
    changed on any tile, or everything did) resampling sees no spread; each cluster then counts as
    one trial and the exact binomial limit 1 − 0.025^(1/C) is used on both sides.

    Args:
        counts: `[S, C, 3]` (both, lost, gained) per series (detector, camouflage) and cluster.
        statistic: takes summed counts `[..., S, 3]`, gives `[...]`; nan where undefined.
        weights: `[R, C]` from `resample`.
        limits: the values that the statistic can take. It is a rate or a difference of rates, and
            so seldom beyond [-1, 1].
    """
    total = counts.sum(axis=1)
    replicates = statistic(resampled(counts, weights))
    left_one_out = statistic(total - counts.transpose(1, 0, 2))
    return bootstrap_interval(float(statistic(total)), replicates, left_one_out, limits)


def mean_interval(
    counts: Int[np.ndarray, "S C 3"],
    rate: Callable[[np.ndarray], np.ndarray],
    weights: Int[np.ndarray, "R C"],
    limits: tuple[float, float],
) -> Interval:
    """Gives the interval of a rate's mean over series (detectors, draws), no surer than they are.

    Where every tile agrees in some series but not in all, resampling sees only the others' spread.
    Then the mean of the series' own margins counts, as if they all erred together: they stand on
    the same tiles.

    Args:
        counts: `[S, C, 3]` (both, lost, gained) per series and cluster.
        rate: takes summed counts `[..., S, 3]`, gives `[..., S]`; nan where undefined.
        weights: `[R, C]` from `resample`.
        limits: the values that the rate can take.
    """
    # The rate of every series: as it is, with each cluster left out, and in the replicates.
    total = counts.sum(axis=1)
    points = rate(total)
    left_one_out = rate(total - counts.transpose(1, 0, 2))
    replicates = rate(resampled(counts, weights))

    # The interval of the mean, which is the answer unless some series are unanimous.
    whole = bootstrap_interval(
        float(points.mean()), replicates.mean(axis=-1), left_one_out.mean(axis=-1), limits
    )
    if whole.unanimous or not any(_agree(column) for column in replicates.T):
        return whole

    # Each series' own interval, and the mean of their margins to either side.
    columns = zip(points, replicates.T, left_one_out.T, strict=True)
    parts = [
        bootstrap_interval(float(point), drawn, without, limits)
        for point, drawn, without in columns
    ]
    below = float(np.mean([part.estimate - part.low for part in parts]))
    above = float(np.mean([part.high - part.estimate for part in parts]))

    # Each limit is the farther of the two, within what the rate can be.
    low = min(whole.low, whole.estimate - below)
    high = max(whole.high, whole.estimate + above)
    return Interval(whole.estimate, max(low, limits[0]), min(high, limits[1]), unanimous=True)


def resampled(
    counts: Num[np.ndarray, "S C 3"], weights: Int[np.ndarray, "R C"]
) -> Float[np.ndarray, "R S 3"]:
    """Sums the counts of every replicate."""
    flat = counts.transpose(1, 0, 2).reshape(counts.shape[1], -1)
    # Floats, because only they are multiplied by fast library code; counts are far below 2^53, so
    # it is exact.
    return (weights.astype(np.float64) @ flat.astype(np.float64)).reshape(
        len(weights), len(counts), 3
    )


def _agree(replicates: Float[np.ndarray, " R"]) -> bool:
    """Says whether all replicates that are defined show the same."""
    defined = replicates[~np.isnan(replicates)]
    return len(defined) > 0 and float(np.ptp(defined)) < 1e-12


def bootstrap_interval(
    estimate: float,
    replicates: Float[np.ndarray, " R"],
    left_one_out: Float[np.ndarray, " C"],
    limits: tuple[float, float],
) -> Interval:
    """Does what `cluster_interval` does, from a statistic's values.

    Args:
        estimate: the statistic of all clusters.
        replicates: `[R]` in the replicates; nan where undefined.
        left_one_out: `[C]` with each cluster left out.
        limits: the values that the statistic can take.
    """
    clusters = len(left_one_out)
    replicates = replicates[~np.isnan(replicates)]
    if math.isnan(estimate) or clusters < 2 or len(replicates) == 0:
        return Interval(estimate, math.nan, math.nan)
    unanimous = _agree(replicates)
    if unanimous:
        margin = unanimous_margin(clusters)
        low = estimate - margin
        high = estimate + margin
    else:
        low, high = np.quantile(replicates, _levels(estimate, replicates, left_one_out))
        lowest, highest = _effective_limits(estimate, left_one_out, (max(limits[0], -1.0), 1.0))
        low = min(low, lowest)
        high = max(high, highest)
    return Interval(estimate, max(float(low), limits[0]), min(float(high), limits[1]), unanimous)


def _effective_limits(
    estimate: float, left_one_out: Float[np.ndarray, " C"], span: tuple[float, float]
) -> tuple[float, float]:
    """Gives `effective_limits` with the jackknife variance over clusters, one left out at a time.

    Its degrees of freedom are what the clusters' influences support, 2 / (relative variance of
    their sample variance): few where few clusters decide (large kurtosis), at most C − 1.
    """
    clusters = len(left_one_out)
    influence = left_one_out[~np.isnan(left_one_out)]
    influence = influence - influence.mean() if len(influence) else np.zeros(1)
    variance = (clusters - 1) / clusters * float(np.sum(influence**2))
    if variance == 0:
        return estimate, estimate
    kurtosis = float(np.mean(influence**4) / np.mean(influence**2) ** 2)
    degrees = min(
        clusters - 1.0, 2 * clusters / max(kurtosis - (clusters - 3) / (clusters - 1), 1e-9)
    )
    return effective_limits(estimate, variance, degrees, span)


def effective_limits(
    estimate: float, variance: float, degrees: float, span: tuple[float, float] = (-1.0, 1.0)
) -> tuple[float, float]:
    """Gives exact binomial limits at the effective sample size.

    The estimate counts as a share p of `span`. p(1 − p) / variance is how many independent vehicles
    would be as telling. That is multiplied by (1.96 / t)², t being Student's quantile, because the
    variance is itself estimated (Korn and Graubard 1998). Nothing is moved where the estimate lies
    on an end of `span` or outside. Differences from Korn and Graubard: the size may exceed the
    sample's.

    Args:
        estimate: a rate or a difference of rates.
        variance: of the estimate.
        degrees: of freedom of the variance.
        span: the smallest and the largest value that the estimate can take.

    Returns:
        The low and the high limit.
    """
    width = span[1] - span[0]
    share = (estimate - span[0]) / width
    if not 0 < share < 1:
        return estimate, estimate
    quantiles = float(special.ndtri(1 - _TAIL) / special.stdtrit(degrees, 1 - _TAIL))
    size = share * (1 - share) / (variance / width**2) * quantiles**2
    hits = share * size
    misses = (1 - share) * size
    low = special.betaincinv(hits, misses + 1, _TAIL)
    high = special.betaincinv(hits + 1, misses, 1 - _TAIL)
    return span[0] + width * float(low), span[0] + width * float(high)


def unanimous_margin(clusters: int) -> float:
    """Says how far the exact binomial limit lies from the estimate where all clusters agree.

    It is 1 − 0.025^(1/C).
    """
    return 1 - _TAIL ** (1 / clusters)


def _levels(
    estimate: float, replicates: Float[np.ndarray, " R"], left_one_out: Float[np.ndarray, " C"]
) -> Float[np.ndarray, " 2"]:
    """Gives the two quantile levels of the bootstrap distribution that BCa reads.

    They are widened for few clusters.
    """
    clusters = len(left_one_out)
    # Ties count half: rates of few vehicles are lumpy.
    below = np.mean(replicates < estimate) + np.mean(replicates == estimate) / 2
    bias = special.ndtri(np.clip(below, 1e-4, 1 - 1e-4))
    left_one_out = left_one_out[~np.isnan(left_one_out)]
    deviation = left_one_out.mean() - left_one_out if len(left_one_out) else np.zeros(1)
    spread = np.sum(deviation**2)
    acceleration = np.sum(deviation**3) / (6 * spread**1.5) if spread > 0 else 0.0
    quantile = special.stdtrit(clusters - 1, 1 - _TAIL) * math.sqrt(clusters / (clusters - 1))
    moved = bias + np.array([-quantile, quantile])
    return special.ndtr(bias + moved / np.maximum(1 - acceleration * moved, 1e-3))


def mcnemar_p(lost: int, gained: int) -> float:
    """Gives the p-value of McNemar's two-sided exact test, from the discordant pairs.

    Its hypothesis is that as many vehicles are lost as gained.

    Vehicles count as independent here; trust the cluster interval more where a tile holds many of
    them.
    """
    discordant = lost + gained
    if not discordant:
        return 1.0
    return min(1.0, 2 * float(stats.binom.cdf(min(lost, gained), discordant, 0.5)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Applies Holm's step-down correction over one table; the order stays as given."""
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        # A later p-value may not come out smaller than an earlier one.
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected
