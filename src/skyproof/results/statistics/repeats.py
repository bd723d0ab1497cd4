"""How far seeds, draws, searches and trainings move a mean of rates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

from skyproof.results.statistics.intervals import TAIL


@dataclass(frozen=True)
class RepeatKind:
    """A kind of repeat, with the standard deviations of its rates that were measured.

    `usual_sd` is the root mean square over the tables of docs/results, and `largest_sd` the largest
    value, which applies to a single repeat. Differences between series of the same repeats, such as
    those under two renderers, have the deviations of `paired` if it is given.
    """

    name: str
    usual_sd: float
    largest_sd: float
    paired: "RepeatKind | None" = None


SEEDS = RepeatKind("seeds", 0.034, 0.046)
"""Seeds of an attack (seed 0). The largest is that of attacked detectors. On held-out ones it is
0.12, so a rate there needs several seeds."""

DRAWS = RepeatKind("draws", 0.09, 0.25, SEEDS)
"""Draws of a random control, the most for detectors of photographs (seed 0, ranges of ten). A draw
acts much alike under two renderers."""

BESTS = RepeatKind("best draws", 0.045, 0.125, SEEDS)
"""Draws of a best-of-N control: half the spread of single draws, because the largest of 32 normal
numbers has 0.49 of their standard deviation (Tippett 1925)."""

SEARCHES = RepeatKind("searches", 0.14, 0.2, SEEDS)
"""Starts of the search for a chosen control. Pairs of R-Fc, R-PixFc and R-Pix differed by 4, 39 and
28 points, and by 19 in the root mean square over four budgets (docs/attacks.md, commit 37a385d)."""

TRAININGS = RepeatKind("trainings", 0.057, 0.19)
"""Trainings of the detectors, each with attacks from another seed (trainings). An attack and a
control on one training are paired, but need not fare alike."""

GIVEN = RepeatKind("given", 0.0, 0.0)
"""What would be the same again: a choice among all plain paints, a camouflage of the user's, or a
single draw that stands for itself."""


@dataclass(frozen=True)
class Repeat:
    """One repeat of something ("R-U", or "detectors"); series with the same number belong to it."""

    of: str
    number: str
    kind: RepeatKind


def spread_of_repeats(
    values: Float[np.ndarray, " S"],
    factors: Float[np.ndarray, " S"],
    repeats: Sequence[Sequence[Repeat]],
) -> tuple[dict[str, float], float, float]:
    """Returns the uncertainty of the mean over all possible repeats, of which only some were run.

    It is the variance by kind of repeat, and the distances to the lower and the upper 95 % limit.

    Per thing repeated, R repeats of standard deviation s reach t · s / √R, with Student's quantile
    of R − 1 degrees of freedom. Few repeats that happen to agree do not count as certain: they
    reach at least as far as the usual standard deviation of the kind with R degrees. A single
    repeat reaches 1.96 times the largest one, and several no farther unless they differ more. Two
    that differ more reach 1.96 times their own standard deviation, because Student's quantile of
    one degree of freedom would cover nearly every rate.

    The distances of several things are squared and added. None reaches beyond the range of a mean
    of repeats: from 0 to 1, or to a repeat that lies beyond. A series may be a repeat of several
    things: a control on the second of three trainings is one of its draws and one of the trainings.
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
        sums = np.zeros(count)
        weights = np.zeros((2, count))
        for place, repeat in places.items():
            at = numbers.index(repeat.number)
            sums[at] += count * factors[place] * values[place]
            weights[int(factors[place] < 0), at] += abs(factors[place])
        kind = next(iter(places.values())).kind
        paired = bool(weights.min() > 0)
        kind = (kind.paired or kind) if paired else kind
        if count == 1 and not kind.largest_sd:
            continue
        scale = float(weights.sum(axis=1).max())
        seen = float(sums.std(ddof=1)) if count > 1 else 0.0
        usual = scale * (kind.usual_sd if count > 1 else kind.largest_sd)
        variance = max(seen, usual) ** 2 / count
        variances[kind.name] = variances.get(kind.name, 0.0) + variance
        single = float(special.ndtri(1 - TAIL)) * scale * kind.largest_sd
        margin = single
        if count > 1:
            apart = float(special.stdtrit(count - 1, 1 - TAIL)) * seen
            expected = float(special.stdtrit(count, 1 - TAIL)) * usual
            margin = max(apart, expected) / math.sqrt(count)
            more = seen / (scale * kind.largest_sd)
            if more <= 1 or count == 2:
                margin = min(margin, single * max(1.0, more))
        if paired:
            margins.append((margin, margin))
            continue
        sign = 1 if weights[1].max() == 0 else -1
        rates = sign * sums / scale
        below = min(margin, scale * float(rates.mean() - min(rates.min(), 0.0)))
        above = min(margin, scale * float(max(rates.max(), 1.0) - rates.mean()))
        margins.append((below, above) if sign > 0 else (above, below))
    below, above = (math.hypot(*(margin[side] for margin in margins)) for side in (0, 1))
    return variances, below, above
