"""Do our results and the paper's order the attacks alike? Rank correlation with an interval (PAPER 35)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from skyproof.camouflage.names import pooled_name
from skyproof.errors import ConfigurationError
from skyproof.evaluate.intervals import Interval, resample, resampled
from skyproof.evaluate.rates import overall_attack_success_rate
from skyproof.evaluate.tiles import TileCounts

__all__ = ["Agreement", "rank_agreement"]

_FEWEST = 3


@dataclass(frozen=True)
class Agreement:
    """How alike two orders of the same attacks are.

    Attributes:
        attacks: names in the paper, in its order of falling success.
        ours, theirs: EASR per attack, fractions and percent.
        spearman, kendall: rank correlations (Kendall's tau-b), 1 for the same order, −1 for the reverse, with the 95 %
            percentile interval over resampled tiles.
    """

    attacks: Sequence[str]
    ours: Sequence[float]
    theirs: Sequence[float]
    spearman: Interval
    kendall: Interval


def rank_agreement(
    tiles: TileCounts,
    paper: Mapping[str, float],
    *,
    rows: Mapping[str, str] | None = None,
    generator: np.random.Generator,
    renderer: str = "torch",
    match: str = "centre_1m",
) -> Agreement:
    """Rank correlation between our EASRs and the paper's over the attacks both have.

    Ours are means over repeats and detectors. The interval says how far the test scenes alone could move the
    correlation: ours vary over resampled tiles, the paper's numbers, which come without intervals, stay fixed.

    Args:
        tiles: our counts.
        paper: EASR by attack, e.g. {name: result.easr for name, result in PAPER_RESULTS.items()}.
        rows: our row for an attack where its name differs, e.g. {"S-O": "S-O@0.4"} at the magnitude to compare.
        generator: of the bootstrap.
        renderer, match: which of the counts.

    Raises:
        ConfigurationError: fewer than three attacks are shared, or one of them is undefined.
    """
    rows = rows or {}
    series: dict[str, list[np.ndarray]] = {}
    for key, counts in tiles.series.items():
        if (key.renderer, key.match) == (renderer, match):
            series.setdefault(pooled_name(key.camouflage), []).append(counts[:, 1:])
    shared = [name for name in sorted(paper, key=lambda name: -paper[name]) if rows.get(name, name) in series]
    if len(shared) < _FEWEST:
        raise ConfigurationError(
            f"A rank correlation with the paper expects at least {_FEWEST} attacks that it has too, got {len(shared)}."
        )
    chosen = [np.stack(series[rows.get(name, name)]) for name in shared]
    theirs = np.array([paper[name] for name in shared])
    ours = np.array([overall_attack_success_rate(stack.sum(axis=1)).mean() for stack in chosen])
    undefined = next((name for name, rate in zip(shared, ours, strict=True) if math.isnan(rate)), None)
    if undefined is not None:
        raise ConfigurationError(f"The EASR of {undefined} is undefined; a detector found no vehicle before it.")
    weights = resample(len(tiles.tiles), generator=generator)
    drawn = np.stack(
        [overall_attack_success_rate(resampled(stack, weights)).mean(axis=-1) for stack in chosen],
        axis=1,
    )
    drawn = drawn[~np.isnan(drawn).any(axis=1)]
    spearman = _interval(_spearman(ours, theirs), np.array([_spearman(row, theirs) for row in drawn]))
    kendall = _interval(_kendall(ours, theirs), np.array([_kendall(row, theirs) for row in drawn]))
    return Agreement(shared, ours.tolist(), theirs.tolist(), spearman, kendall)


def _spearman(one: Float[np.ndarray, " A"], other: Float[np.ndarray, " A"]) -> float:
    """Pearson's correlation of the ranks; nan where all of one are equal."""
    ranks = stats.rankdata(np.stack([one, other]), axis=1)
    if np.ptp(ranks, axis=1).min() == 0:
        return math.nan
    return float(np.corrcoef(ranks)[0, 1])


def _kendall(one: Float[np.ndarray, " A"], other: Float[np.ndarray, " A"]) -> float:
    """Tau-b; nan where all of one are equal."""
    first, second = (np.sign(values[:, None] - values) for values in (one, other))
    pairs = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / pairs) if pairs else math.nan


def _interval(estimate: float, drawn: Float[np.ndarray, " R"]) -> Interval:
    drawn = drawn[~np.isnan(drawn)]
    if len(drawn) == 0:
        return Interval(estimate, math.nan, math.nan)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(estimate, min(float(low), estimate), max(float(high), estimate))
