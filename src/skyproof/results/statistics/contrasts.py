"""Means of rates over series, differences of means with their intervals, and tests of them."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Num
from scipy import special

from skyproof.results.statistics.intervals import (
    TAIL,
    Interval,
    Sample,
    bootstrap_interval,
    is_unanimous,
    overall_attack_success_rate,
    resampled,
)
from skyproof.results.statistics.repeats import Repeat, spread_of_repeats

# Tiles' sums are rounded down to this part of the largest that counts.
_STEPS = 4096

RateFunction = Callable[[np.ndarray], np.ndarray]
"""From summed counts `[..., S, 3]` to rates `[..., S]`; nan where undefined."""


@dataclass(frozen=True)
class Group:
    """Counted outcomes (both, lost, gained) of several series on one sample, for their mean.

    `repeats` names what each series is a repeat of; empty if the series are taken as given. The
    mean is over the names in `of`, each the mean of its own series, so that a camouflage counts
    once however often it was repeated; without `of`, it is over the series. `ends` are the counts
    at the other thresholds that chance might have set.
    """

    counts: Int[np.ndarray, "S N 3"]
    sample: Sample
    repeats: Sequence[Sequence[Repeat]] = ()
    of: Sequence[str] = ()
    ends: Sequence[Int[np.ndarray, "S N 3"]] = ()

    @cached_property
    def factors(self) -> Float[np.ndarray, " S"]:
        """Weight of each series in the mean."""
        of = self.of or range(len(self.counts))
        series = Counter(of)
        return np.array([1 / (len(series) * series[each]) for each in of])

    @property
    def rate(self) -> float:
        """The mean EASR."""
        return float(overall_attack_success_rate(self.counts.sum(axis=1)) @ self.factors)

    @cached_property
    def easr(self) -> "_Values":
        """EASR of every series, kept because it stands in many contrasts."""
        return _Values.of(self, overall_attack_success_rate)


def mean_interval(
    group: Group,
    *,
    rate: RateFunction = overall_attack_success_rate,
    limits: tuple[float, float] = (-math.inf, 1.0),
) -> Interval:
    """Returns the interval of a rate's mean over series, no narrower than these justify.

    It covers which tiles and vehicles were drawn and, where there are several, which seeds, draws,
    trainings (`spread_of_repeats`) or thresholds. `limits` are the rate's smallest and largest
    value.
    """
    values = group.easr if rate is overall_attack_success_rate else _Values.of(group, rate)
    mean = values.mean(group.factors, limits)
    moved = [float(rate(end.sum(axis=1)) @ group.factors) for end in group.ends]
    return _widened(mean, values.points, group.factors, group.repeats, limits, moved)


def difference_interval(plus: Sequence[Group], minus: Sequence[Group]) -> Interval:
    """Returns the sum of some groups' mean EASRs minus that of others, paired by tile and vehicle.

    All groups are on one sample. Series of the same repeat in several groups are paired by it, too.

    Either limit is the farther of two: BCa's of the difference, and the one that the groups' own
    limits make by the square-and-add rule with their correlation over resampled tiles (MOVER; Zou
    and Donner 2008), which is how the exact limits of rates near 0 and 1 enter. Resampling sees no
    spread in a series where every tile agrees, such as an attack that hides every vehicle: its
    group counts as correlated with none.
    """
    groups = [*plus, *minus]
    factors = np.concatenate(
        [*(group.factors for group in plus), *(-group.factors for group in minus)]
    )
    limits = (-math.inf, math.inf)
    together = _Values.joined([group.easr for group in groups])
    whole = together.interval(factors, limits, exact=False)
    parts = [group.easr.mean(group.factors, (-math.inf, 1.0)) for group in groups]
    replicates = [group.easr.replicates @ group.factors for group in groups]
    lower, upper = _square_and_add(np.stack(replicates), parts, len(plus))
    if not math.isnan(lower + upper):
        low = min(whole.low, whole.estimate - lower)
        high = max(whole.high, whole.estimate + upper)
        agreed = whole.unanimous or any(part.unanimous for part in parts)
        whole = replace(whole, low=low, high=high, unanimous=agreed)
    repeats = [own for group in groups for own in group.repeats or [()] * len(group.counts)]
    ends = [np.concatenate(end) for end in zip(*(group.ends for group in groups), strict=True)]
    moved = [float(overall_attack_success_rate(end.sum(axis=1)) @ factors) for end in ends]
    return _widened(whole, together.points, factors, repeats, limits, moved)


@dataclass(frozen=True)
class _Values:
    """A rate of each series: its estimate, its replicates, and its values with parts left out."""

    points: Float[np.ndarray, " S"]
    replicates: Float[np.ndarray, "R S"]
    tiles: Float[np.ndarray, "C S"]
    vehicles: Float[np.ndarray, "V S"]
    cells: Float[np.ndarray, "N S"]
    telling: Int[np.ndarray, " S"]
    """Number of tiles, or vehicles where these are fewer, on which each series is defined."""

    @classmethod
    def of(cls, group: Group, rate: RateFunction) -> "_Values":
        counts, sample = group.counts, group.sample
        tiles, vehicles = sample.by_tile(counts), sample.by_vehicle(counts)
        total = tiles.sum(axis=1)

        def told(parts: Num[np.ndarray, "S G 3"]) -> Int[np.ndarray, " S"]:
            return (~np.isnan(rate(parts.transpose(1, 0, 2)))).sum(axis=0)

        def without(parts: Num[np.ndarray, "S G 3"]) -> Float[np.ndarray, "G S"]:
            return rate(total - parts.transpose(1, 0, 2))

        return cls(
            rate(total),
            rate(resampled(tiles, sample.weights)),
            without(tiles),
            without(vehicles),
            without(counts),
            # A fleet of one vehicle says nothing of others, however many tiles it stood on.
            np.minimum(told(tiles), told(vehicles)) if vehicles.shape[1] > 1 else told(tiles),
        )

    @classmethod
    def joined(cls, each: "Sequence[_Values]") -> "_Values":
        """The series of all of them."""
        parts = zip(*(vars(values).values() for values in each), strict=True)
        return cls(*(np.concatenate(part, axis=-1) for part in parts))

    def interval(
        self, factors: Float[np.ndarray, " S"], limits: tuple[float, float], *, exact: bool = True
    ) -> Interval:
        """Returns the interval of the sum of the rates, each multiplied by its factor."""
        return bootstrap_interval(
            float(self.points @ factors),
            self.replicates @ factors,
            self.tiles @ factors,
            limits,
            int(self.telling[factors != 0].min()),
            (self.vehicles @ factors, self.cells @ factors),
            exact=exact,
        )

    def mean(self, factors: Float[np.ndarray, " S"], limits: tuple[float, float]) -> Interval:
        """Returns the interval of the mean, no narrower than the series' own intervals require.

        Where every tile agrees in some series but not in all, resampling sees only the others'
        spread. Then the mean of the series' margins counts, as if they all erred together.
        """
        whole = self.interval(factors, limits)
        if whole.unanimous or not any(is_unanimous(column) for column in self.replicates.T):
            return whole
        parts = [self.interval(own, limits) for own in np.eye(len(factors))]
        below = float(factors @ [part.estimate - part.low for part in parts])
        above = float(factors @ [part.high - part.estimate for part in parts])
        low = max(min(whole.low, whole.estimate - below), limits[0])
        high = min(max(whole.high, whole.estimate + above), limits[1])
        return replace(whole, low=low, high=high, unanimous=True)


def _square_and_add(
    means: Float[np.ndarray, "G R"], parts: Sequence[Interval], count: int
) -> tuple[float, float]:
    """Returns the distances of the limits of the first `count` groups' sum minus the others'."""
    signs = np.where(np.arange(len(parts)) < count, 1.0, -1.0)
    below = np.array([part.estimate - part.low for part in parts])
    above = np.array([part.high - part.estimate for part in parts])
    means = means[:, ~np.isnan(means).any(axis=0)]
    if not means.shape[1]:
        return math.nan, math.nan
    varies = np.array([not is_unanimous(own) for own in means])
    correlation = np.eye(len(means))
    correlation[np.ix_(varies, varies)] = np.corrcoef(means[varies])

    def margin(added: Float[np.ndarray, " G"], taken: Float[np.ndarray, " G"]) -> float:
        moved = signs * np.where(signs > 0, added, taken)
        return math.sqrt(max(float(moved @ correlation @ moved), 0.0))

    return margin(below, above), margin(above, below)


def _widened(
    whole: Interval,
    values: Float[np.ndarray, " S"],
    factors: Float[np.ndarray, " S"],
    repeats: Sequence[Sequence[Repeat]],
    limits: tuple[float, float],
    moved: Sequence[float],
) -> Interval:
    """Widens an interval by what repeats and thresholds add: half-widths are squared and added.

    At the thresholds' 95 % limits the estimate is `moved`; the farther one on each side counts.
    """
    if math.isnan(whole.low):
        return whole
    variances, below, above = spread_of_repeats(values, factors, repeats)
    errors = {name: math.sqrt(variance) for name, variance in variances.items()}
    down = whole.estimate - np.nanmin([whole.estimate, *moved])
    up = np.nanmax([whole.estimate, *moved]) - whole.estimate
    if moved:
        errors["thresholds"] = float(up + down) / 2 / float(special.ndtri(1 - TAIL))
    low = max(whole.estimate - math.hypot(whole.estimate - whole.low, below, down), limits[0])
    high = min(whole.estimate + math.hypot(whole.high - whole.estimate, above, up), limits[1])
    return replace(whole, low=low, high=high, errors=whole.errors | errors)


def unchanged_p(totals: Int[np.ndarray, "repeats 3"]) -> float:
    """Returns the largest of the repeats' McNemar p-values; 1 where they point both ways."""
    balance = totals[:, 1] - totals[:, 2]
    if balance.min() < 0 < balance.max():
        return 1.0
    return max(mcnemar_p(int(lost), int(gained)) for _, lost, gained in totals)


def mcnemar_p(lost: int, gained: int) -> float:
    """Returns the p-value of McNemar's two-sided exact test, from the discordant pairs.

    Its hypothesis is that as many vehicles are lost as gained. Vehicles count as independent here;
    trust the interval more where a tile holds many of them.
    """
    return min(1.0, 2 * float(special.bdtr(min(lost, gained), lost + gained, 0.5)))


def control_p(
    optimised: Float[np.ndarray, "repeats C"], drawn: Float[np.ndarray, "draws C"]
) -> float:
    """Returns the largest p of optimised camouflages against draws of their control, in all pairs.

    The hypothesis is that chance decides on each tile which of the two hides more. So optimised and
    drawn are swapped tile by tile in all ways. p is the share of swaps, the observed one included,
    after which the sums differ by as much, in either direction. It is 1 unless the optimised one
    hides more in every pair. Tiles count as independent. The arguments are vehicles lost minus
    gained per tile, summed over detectors, each divided by the vehicles that it found before.
    """
    differences = (optimised[:, None] - drawn[None]).reshape(-1, optimised.shape[1])
    # Sums of fractions that are equal may differ by rounding.
    slack = 1e-9 * max(float(np.abs(differences).sum(axis=1).max()), 1e-300)
    if not differences.sum(axis=1).min() > slack:
        return 1.0
    return min(1.0, max(_swapped_p(each, slack) for each in differences))


def _swapped_p(differences: Float[np.ndarray, " C"], slack: float) -> float:
    """Returns the share of all swaps after which a sum is as far from 0.

    Tiles of sum `room` or less may be turned against the others. Their sums are counted on a grid,
    rounded down, so p comes out too large by a few percent of itself at most.
    """
    sizes = np.abs(differences)
    room = (float(sizes.sum()) - float(differences.sum())) / 2 + slack
    steps = np.minimum(sizes * (_STEPS / room), _STEPS + 1).astype(np.int64)
    shares = np.zeros(_STEPS + 1)
    shares[0] = 1.0
    for step in steps:
        shares[step:] += shares[: _STEPS + 1 - step].copy()
        shares /= 2
    return 2 * float(shares.sum())


def holm(p_values: Sequence[float]) -> list[float]:
    """Applies Holm's step-down correction over one family of tests; the order stays as given."""
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        # A later p-value may not come out smaller than an earlier one.
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected
