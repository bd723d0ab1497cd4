"""How far seeds of an attack, draws of a control and trainings of detectors leave a mean open."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

_TAIL = 0.025


@dataclass(frozen=True)
class Kind:
    """What sort of repeats these are.

    Attributes:
        name: "seeds", "draws" or "trainings".
        usual_sd: the standard deviation of their rates that is expected before they are seen. It
            counts as one repeat.
        paired_sd: the same of the differences between what each repeat does in two places.
    """

    name: str
    usual_sd: float
    paired_sd: float


SEEDS = Kind("seeds", 0.07, 0.07)
"""Of a learnt camouflage. Three seeds each had a standard deviation of 0.11 for S-O, and of 0.01 at
most for textures (quick preset of 2026-11-21). With 0.05 three simulated seeds of standard
deviation 0.1 held the truth in 92 % of runs at worst, with 0.07 in 96 %."""

DRAWS = Kind("draws", 0.5, SEEDS.usual_sd)
"""Of a random control: the largest standard deviation that a rate between 0 and 1 can have.
Controls of few colours come near it: three draws of R-Lc hid 5, 27 and 91 %, R-PixLc −1, 35 and
92 %. What a draw does under one renderer it does much alike under another: of such differences no
more is expected than of seeds."""

TRAININGS = Kind("trainings", 0.1, 0.1)
"""Of the detectors, each with attacks of its own: with another training comes another seed, too.
Measured since this was chosen were 0.002 to 0.11 for means over three detectors, and up to 0.19 for
a single one (docs/results/trainings). Three simulated trainings of standard deviation 0.15, as of
trainings and seeds by some 0.1 each, held the truth in 93 % of runs at worst, with 0.07 in 91 %. An
attack and a control before the same training are paired, but need not fare alike, so that no less
is expected of their difference."""


@dataclass(frozen=True)
class Repeat:
    """Which repeat a series belongs to.

    Attributes:
        of: what is repeated: "R-U", or "detectors".
        number: which it is; series that share it (detectors, renderers) are of one repeat.
        kind: what sort of repeat.
    """

    of: str
    number: str
    kind: Kind


@dataclass(frozen=True)
class Spread:
    """What repeats leave open of a sum of rates.

    Attributes:
        variances: of the sum, by name of the kind.
        below, above: how far the 95 % limits lie from the sum on either side.
    """

    variances: dict[str, float]
    below: float
    above: float


def spread_of_repeats(
    values: Float[np.ndarray, " S"],
    factors: Float[np.ndarray, " S"],
    repeats: Sequence[Sequence[Repeat]],
) -> Spread:
    """Says how far the repeats that were seen leave the mean of all open.

    Per thing repeated, R repeats have the variance (σ² + Σ (x − mean)²) / R of one of them, with R
    degrees of freedom: the repeat that was expected, σ off the mean, and those that were seen. So
    few repeats that happen to agree do not pass for certain, and many speak for themselves. What
    was not repeated adds nothing: then the interval is about this very seed, draw or training.

    Half-widths are Student's; those of several things are squared and added. None reaches farther
    than the mean of repeats can lie: from 0 to 1, or to a repeat that lies beyond.

    Args:
        values: the series' rates.
        factors: by which they are multiplied in the sum.
        repeats: of each series, one for each thing of which it is a repeat: a control before the
            second of three trainings is one of its draws and one of the trainings.
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
        variance = _variance(usual * scale, count, float(np.sum((sums - sums.mean()) ** 2)))
        variances[kind.name] = variances.get(kind.name, 0.0) + variance
        margin = math.sqrt(variance) * _quantile(count)
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


def _variance(usual_sd: float, count: int, squares: float) -> float:
    """Gives the variance of the mean, from the summed squares about it."""
    return (usual_sd**2 + squares) / count**2


def _quantile(degrees: int) -> float:
    return float(special.stdtrit(degrees, 1 - _TAIL))
