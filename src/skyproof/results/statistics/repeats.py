"""The part of an interval due to seeds of an attack, draws of a control and trainings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

_TAIL = 0.025


@dataclass(frozen=True)
class RepeatKind:
    """A kind of repeat, with the expected standard deviation of its rates, which counts as one.

    `paired_sd` is that of a repeat's differences between two places.
    """

    name: str
    usual_sd: float
    paired_sd: float


SEEDS = RepeatKind("seeds", 0.07, 0.07)
"""Seeds of an attack. Three seeds each had a standard deviation of 0.11 for S-O, and of 0.01 at
most for textures (quick preset of 2026-11-21). With 0.05 three simulated seeds of standard
deviation 0.1 held the truth in 92 % of runs at worst, with 0.07 in 96 %."""

DRAWS = RepeatKind("draws", 0.5, SEEDS.usual_sd)
"""Draws of a random control: the largest standard deviation of a rate between 0 and 1. Controls of
few colours come near it: three draws of R-Lc hid 5, 27 and 91 %, R-PixLc −1, 35 and 92 %. A draw
acts much alike under two renderers, so their differences have the standard deviation of seeds."""

TRAININGS = RepeatKind("trainings", 0.1, 0.1)
"""Trainings of the detectors, each with attacks from another seed. Measured were 0.002 to 0.11
for means over three detectors, and up to 0.19 for a single one (docs/results/trainings). Three
simulated trainings of standard deviation 0.15 held the truth in 93 % of runs at worst, with 0.07 in
91 %. An attack and a control on one training are paired, but need not fare alike, so their
difference has the same standard deviation."""


@dataclass(frozen=True)
class Repeat:
    """The repeat of something ("R-U", or "detectors") that a series belongs to.

    Series that share the number (detectors, renderers) are of one repeat.
    """

    of: str
    number: str
    kind: RepeatKind


@dataclass(frozen=True)
class Spread:
    """The variances of a sum of rates by kind of repeat, and the distances of its 95 % limits."""

    variances: dict[str, float]
    below: float
    above: float


def spread_of_repeats(
    values: Float[np.ndarray, " S"],
    factors: Float[np.ndarray, " S"],
    repeats: Sequence[Sequence[Repeat]],
) -> Spread:
    """Gives the uncertainty of the mean over all repeats, of which some were seen.

    Per thing repeated, R repeats have the variance (σ² + Σ (x − mean)²) / R of one of them, with R
    degrees of freedom: the expected repeat, σ off the mean, and those seen. So few repeats that
    happen to agree do not pass for certain. A single repeat adds nothing: then the interval applies
    to this seed, draw or training alone.

    Half-widths are Student's; those of several things are squared and added. None reaches beyond
    the range of a mean of repeats: from 0 to 1, or to a repeat that lies beyond. A series may be a
    repeat of several things: a control on the second of three trainings is one of its draws and one
    of the trainings.
    """
    variances: dict[str, float] = {}
    margins: list[tuple[float, float]] = []
    every: dict[str, dict[int, Repeat]] = {}
    for place, own in enumerate(repeats):
        for repeat in own:
            every.setdefault(repeat.of, {})[place] = repeat
    for places in every.values():
        numbers = list(dict.fromkeys(repeat.number for repeat in places.values()))
        count = len(numbers)
        if count < 2:
            continue
        sums = np.zeros(count)
        weights = np.zeros((2, count))
        for place, repeat in places.items():
            at = numbers.index(repeat.number)
            sums[at] += count * factors[place] * values[place]
            weights[int(factors[place] < 0), at] += abs(factors[place])
        kind = next(iter(places.values())).kind
        paired = bool(weights.min() > 0)
        usual = kind.paired_sd if paired else kind.usual_sd
        scale = float(weights.sum(axis=1).max())
        squares = float(np.sum((sums - sums.mean()) ** 2))
        variance = ((usual * scale) ** 2 + squares) / count**2
        variances[kind.name] = variances.get(kind.name, 0.0) + variance
        margin = math.sqrt(variance) * float(special.stdtrit(count, 1 - _TAIL))
        if paired:
            margins.append((margin, margin))
            continue
        sign = 1 if weights[1].max() == 0 else -1
        rates = sign * sums / scale
        below = min(margin, scale * float(rates.mean() - min(rates.min(), 0.0)))
        above = min(margin, scale * float(max(rates.max(), 1.0) - rates.mean()))
        margins.append((below, above) if sign > 0 else (above, below))
    return Spread(
        variances,
        math.hypot(*(below for below, _ in margins)),
        math.hypot(*(above for _, above in margins)),
    )
