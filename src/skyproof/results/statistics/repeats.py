"""How far the seeds of an attack, or the draws of a control, leave their mean open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

__all__ = ["DRAWS", "SEEDS", "Kind", "Repeat", "Spread", "expected_margin", "spread_of_repeats"]

_TAIL = 0.025


@dataclass(frozen=True)
class Kind:
    """What sort of repeats these are.

    Attributes:
        name: "seeds" or "draws".
        usual_sd: the standard deviation of their rates that is expected before they are seen. It
            counts as one repeat.
    """

    name: str
    usual_sd: float


SEEDS = Kind("seeds", 0.07)
"""Of a learnt camouflage. Three seeds each had a standard deviation of 0.11 for S-O, and of 0.01 at
most for textures (docs/results/quick). With 0.05 three simulated seeds of standard deviation 0.1
held the truth in 92 % of runs at worst, with 0.07 in 96 %."""

DRAWS = Kind("draws", 0.5)
"""Of a random control: the largest standard deviation that a rate between 0 and 1 can have.
Controls of few colours come near it: three draws of R-Lc hid 5, 27 and 91 %, R-PixLc −1, 35 and
92 %."""


@dataclass(frozen=True)
class Repeat:
    """Which repeat a series belongs to.

    Attributes:
        of: what is repeated: "R-U".
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
    repeats: Sequence[Repeat],
) -> Spread:
    """Says how far the repeats that were seen leave the mean of all open.

    Per thing repeated, R repeats have the variance (σ² + Σ (x − mean)²) / R of one of them, with R
    degrees of freedom: the repeat that was expected, σ off the mean, and those that were seen. So
    few repeats that happen to agree do not pass for certain, and many speak for themselves. Of
    draws that are paired, as under two renderers, no more is expected than of seeds. What was not
    repeated adds nothing: then the interval is about this very seed or draw.

    Half-widths are Student's; those of several things are squared and added. None reaches farther
    than the mean of repeats can lie: from 0 to 1, or to a repeat that lies beyond.

    Args:
        values: the series' rates.
        factors: by which they are multiplied in the sum.
        repeats: of each series.
    """
    variances: dict[str, float] = {}
    margins: list[tuple[float, float]] = []
    for of in dict.fromkeys(repeat.of for repeat in repeats):
        places = [place for place, repeat in enumerate(repeats) if repeat.of == of]
        numbers = list(dict.fromkeys(repeats[place].number for place in places))
        count = len(numbers)
        if count < 2:
            continue
        sums = np.zeros(count)
        weights = np.zeros((2, count))
        for place in places:
            at = numbers.index(repeats[place].number)
            sums[at] += count * factors[place] * values[place]
            weights[int(factors[place] < 0), at] += abs(factors[place])
        kind = repeats[places[0]].kind
        paired = bool(weights.min() > 0)
        # What a repeat does under one renderer it does much alike under another.
        usual = min(kind.usual_sd, SEEDS.usual_sd) if paired else kind.usual_sd
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


def expected_margin(kind: Kind, count: int, sd: float) -> float:
    """Expects the half-width that so many repeats make; 0 of a single one.

    Args:
        kind: what sort they are.
        count: how many.
        sd: the standard deviation that they have.
    """
    if count < 2:
        return 0.0
    return math.sqrt(_variance(kind.usual_sd, count, (count - 1) * sd**2)) * _quantile(count)


def _variance(usual_sd: float, count: int, squares: float) -> float:
    """Gives the variance of the mean, from the summed squares about it."""
    return (usual_sd**2 + squares) / count**2


def _quantile(degrees: int) -> float:
    return float(special.stdtrit(degrees, 1 - _TAIL))
