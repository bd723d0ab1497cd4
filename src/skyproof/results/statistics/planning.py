"""Says how many test vehicles a wanted precision needs.

The answer comes from assumptions, or from a pilot evaluation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from msgspec import Meta

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, check_ranges
from skyproof.results.pairs.counts import OutcomeCounts
from skyproof.results.repeats import repeat_of
from skyproof.results.statistics.intervals import effective_limits, unanimous_margin
from skyproof.results.statistics.rates import overall_attack_success_rate
from skyproof.results.statistics.repeats import DRAWS, SEEDS, TRAININGS, Kind, expected_margin
from skyproof.results.statistics.sample import Sample

SMALLEST = 0.001
_MOST_TILES = 10**9

SEED_SD = 0.03
"""Of the seeds of an attack: the root mean square over 13 camouflages of three seeds each."""

DRAW_SD = 0.2
"""Of the draws of a control: the same over 12 controls of three draws each (quick preset of
2026-11-21)."""

TRAINING_SD = TRAININGS.usual_sd
"""Of the trainings of a detector, where a run tells nothing: what intervals expect of them."""


@dataclass(frozen=True)
class Assumptions:
    """What is assumed of the test to come, for one detector.

    Attributes:
        easr: overall attack success rate, in [-1, 1].
        enhancement_rate: ER, vehicles found only with the camouflage over those found before.
        vehicles_per_tile: in sight, per background tile.
        found_before: share of them that the detector finds without camouflage, in (0, 1].
        design_effect: how many times larger the variance is than with independent vehicles, at
            least 1. It is 1 + (m − 1)ρ for m found vehicles a tile with intra-tile correlation ρ.
        fleet: different vehicles, each of which stands on many tiles; with 1 the answer is about
            this one.
        vehicle_correlation: how alike one vehicle of the fleet fares on different tiles, in [0, 1].
        seeds: attacks from different seeds whose mean is wanted; with 1 the answer is about this
            one. Where there are several trainings, what seeds add is part of how these differ.
        seed_sd: standard deviation of their EASRs.
        draws: of the random control, whose mean is subtracted for the net EASR; with 0 there is no
            control, with 1 the answer is about this one.
        draw_sd: standard deviation of their EASRs.
        trainings: of the detector, each with attacks of its own, whose mean is wanted; with 1 the
            answer is about this one.
        training_sd: standard deviation of their EASRs, or net EASRs where there are draws, each the
            mean over its seeds.
    """

    easr: Annotated[float, Meta(ge=-1, le=1)]
    enhancement_rate: Annotated[float, Meta(ge=0, le=2)] = 0.0
    vehicles_per_tile: Annotated[float, Meta(gt=0, le=1e6)] = 9.0
    found_before: Annotated[float, Meta(gt=0, le=1)] = 1.0
    design_effect: Annotated[float, Meta(ge=1, le=1e6)] = 1.8
    fleet: Annotated[int, Meta(ge=1, le=10**6)] = 32
    vehicle_correlation: Fraction = 0.05
    seeds: Annotated[int, Meta(ge=1, le=1000)] = 1
    seed_sd: Fraction = SEED_SD
    draws: Annotated[int, Meta(ge=0, le=1000)] = 0
    draw_sd: Fraction = DRAW_SD
    trainings: Annotated[int, Meta(ge=1, le=1000)] = 1
    training_sd: Fraction = TRAINING_SD

    def __post_init__(self) -> None:
        check_ranges(self)
        rate = self.easr + self.enhancement_rate
        if not -1e-9 <= rate <= 1 + 1e-9:
            raise ConfigurationError(
                "EASR expects a fraction of at most 1 whose sum with ER (the attack success rate) "
                f"lies between 0 and 1, got EASR {self.easr:g} and ER {self.enhancement_rate:g}."
            )


@dataclass(frozen=True)
class Need:
    """The test that gives a half-width.

    It has so many background tiles, with so many vehicles in sight altogether.
    """

    half_width: float
    tiles: int
    vehicles: int


def vehicles_needed(half_width: float, assumptions: Assumptions) -> Need:
    """Finds the smallest test whose 95 % interval of EASR is at most ± `half_width`, as expected.

    Raises:
        ConfigurationError: the half-width is not in [0.001, 1), or no number of tiles gives it.
    """
    if not SMALLEST <= half_width < 1:
        raise ConfigurationError(
            f"The half-width expects a fraction from {SMALLEST} to below 1, got {half_width:g}."
        )
    least = expected_half_width(_MOST_TILES, assumptions)
    if least > half_width:
        parts = parts_of_width(_MOST_TILES, assumptions)
        what = max(parts, key=lambda part: parts[part])
        more = "different vehicles" if what == "vehicles" else what
        raise ConfigurationError(
            f"On no number of tiles is the interval as narrow as ±{100 * half_width:.3g} "
            f"percentage points, with so few {what} at best ±{100 * least:.3g}; ask for less, or "
            f"for more {more}."
        )
    # A number of tiles that is enough, by doubling.
    enough = 2
    while expected_half_width(enough, assumptions) > half_width:
        enough *= 2
    # The smallest one, by halving what lies between too few and enough.
    few = enough // 2
    while enough - few > 1:
        middle = (few + enough) // 2
        if middle >= 2 and expected_half_width(middle, assumptions) <= half_width:
            enough = middle
        else:
            few = middle
    return Need(half_width, enough, math.ceil(enough * assumptions.vehicles_per_tile))


def tiles_to_show(needed: int, scenes: int) -> int:
    """Gives the tiles of which so many scenes, each on a tile drawn with replacement, show enough.

    Args:
        needed: tiles to be shown, on average; fewer than there are scenes.
        scenes: how many are drawn.
    """
    tiles = needed
    while tiles * (1 - (1 - 1 / tiles) ** scenes) < needed:
        tiles += 1
    return tiles


def expected_half_width(tiles: int, assumptions: Assumptions) -> float:
    """Expects half the width of the interval that results will have, about.

    It holds for one detector with so many tiles. The variance of EASR is that of a ratio,
    linearised: of the vehicles found before, a share ASR is lost (influence 1 − EASR) and the rest
    kept (−EASR), and ER as many are gained (−1). That is multiplied by the design effect, and
    vehicles add their correlated part of it. Half-widths of seeds, draws and trainings are squared
    and added. Of the control only the draws count: it hides little, so that tiles move it less.
    """
    easr = assumptions.easr
    by_tiles, by_vehicles = _variances(tiles, assumptions)
    if by_tiles + by_vehicles < 1e-15:
        fleet = assumptions.fleet if assumptions.fleet > 1 else tiles
        margin = unanimous_margin(min(tiles, fleet))
        width = (min(easr + margin, 1.0) - (easr - margin)) / 2
    else:
        degrees = tiles - 1.0
        if by_vehicles:
            share = by_vehicles / (by_tiles + by_vehicles)
            degrees = 1 / ((1 - share) ** 2 / degrees + share**2 / (assumptions.fleet - 1))
        low, high = effective_limits(easr, by_tiles + by_vehicles, degrees)
        width = (high - low) / 2
    return math.hypot(width, *_repeat_margins(assumptions).values())


def parts_of_width(tiles: int, assumptions: Assumptions) -> dict[str, float]:
    """Gives which share of the squared half-width is due to what, by name; what adds nothing lacks.

    "tiles" are the tiles with the chance of the single vehicles on them.
    """
    by_tiles, by_vehicles = _variances(tiles, assumptions)
    margins = {name: margin**2 for name, margin in _repeat_margins(assumptions).items()}
    cells = expected_half_width(tiles, assumptions) ** 2 - sum(margins.values())
    if by_tiles + by_vehicles:
        share = by_vehicles / (by_tiles + by_vehicles)
    else:
        share = float(1 < assumptions.fleet < tiles)
    parts = {"tiles": cells * (1 - share), "vehicles": cells * share, **margins}
    total = sum(parts.values())
    return {name: part / total for name, part in parts.items() if part > 0}


def _variances(tiles: int, assumptions: Assumptions) -> tuple[float, float]:
    """Gives the variance of EASR by tiles, and what vehicles add to it."""
    unit = _unit_variance(assumptions.easr, assumptions.enhancement_rate)
    found = tiles * assumptions.vehicles_per_tile * assumptions.found_before
    by_vehicles = unit * assumptions.vehicle_correlation / assumptions.fleet
    return unit * assumptions.design_effect / found, by_vehicles if assumptions.fleet > 1 else 0.0


def _repeat_margins(assumptions: Assumptions) -> dict[str, float]:
    margins = {
        kind.name: expected_margin(kind, count, sd)
        for kind, count, sd in (
            (SEEDS, assumptions.seeds if assumptions.trainings == 1 else 1, assumptions.seed_sd),
            (DRAWS, assumptions.draws, assumptions.draw_sd),
            (TRAININGS, assumptions.trainings, assumptions.training_sd),
        )
    }
    return {name: margin for name, margin in margins.items() if margin}


def assume_from_pilot(tiles: OutcomeCounts, *, match: str = "centre_1m") -> tuple[Assumptions, str]:
    """Takes assumptions from a pilot evaluation: its least certain learnt camouflage and detector.

    Rates, vehicles a tile and the share found before are that series' own. The design effect and
    the correlation of vehicles, which a pilot tells only roughly, are medians over all series
    (jackknife variance over tiles, and what vehicles add to it, against that of independent
    vehicles). Seeds and draws differ by the root of their mean variance, where the pilot has
    several.

    Args:
        tiles: counts of the pilot.
        match: the match criterion whose counts are taken.

    Returns:
        The assumptions, and the names of that camouflage and detector.

    Raises:
        ConfigurationError: the pilot has no learnt camouflage, fewer than three tiles, or nothing
            changed in it.
    """
    # Design effect and uncertainty of every learnt series that tells something.
    effects: list[float] = []
    correlations: list[float] = []
    series: list[tuple[float, str, Int[np.ndarray, "C 4"], int]] = []
    for key, counts in tiles.series.items():
        total = counts.sum(axis=0)
        found = int(total[1] + total[2])
        camouflage = CamouflageName.read(key.camouflage)
        if camouflage.random or camouflage.kept_copy or key.match != match or not found:
            continue
        seen = counts[:, 0] > 0
        cells = [cell for cell, here in zip(tiles.cells, seen, strict=True) if here]
        sample = Sample.draw(cells, generator=np.random.default_rng(0), replicates=1)
        shown = sample.by_tile(counts[seen][None])[0]
        easr = float((total[2] - total[3]) / found)
        gained = float(total[3] / found)
        independent = _unit_variance(easr, gained) / found
        if len(shown) < 3 or independent <= 1e-15:
            continue
        influence = counts[seen] @ np.array([0.0, -easr, 1 - easr, -1.0]) / found
        by_tile, by_vehicle = (
            _clustered(sums(influence[None, :, None]).ravel())
            for sums in (sample.by_tile, sample.by_vehicle)
        )
        fleet = len({vehicle for _, vehicle in cells})
        effects.append(max(by_tile / independent, 1.0))
        if fleet > 1:
            added = by_vehicle - float(np.sum(influence**2))
            correlations.append(added * fleet / (independent * found))
        name = f"{key.camouflage} before {key.detector}"
        series.append((independent * found, name, shown, fleet))
    if not series:
        raise ConfigurationError(
            "The pilot tells nothing about precision: expected is a learnt camouflage on at least "
            "three tiles that hides some vehicles and not all; give --easr and the rest yourself."
        )

    # The least certain series gives the rates.
    _, name, shown, fleet = max(series, key=lambda candidate: candidate[0])
    vehicles, both, lost, gone = (int(value) for value in shown.sum(axis=0))
    found = both + lost
    correlation = float(np.median(correlations)) if correlations else 0.0
    assumptions = Assumptions(
        easr=(lost - gone) / found,
        enhancement_rate=gone / found,
        vehicles_per_tile=vehicles / len(shown),
        found_before=found / vehicles,
        design_effect=float(np.median(effects)),
        fleet=fleet,
        vehicle_correlation=min(max(correlation, 0.0), 1.0),
        seed_sd=_spread(tiles, SEEDS, match, SEED_SD),
        draw_sd=_spread(tiles, DRAWS, match, DRAW_SD),
    )
    return assumptions, name


def _clustered(influence: Float[np.ndarray, " G"]) -> float:
    """Gives the variance of a sum of clusters' influences; 0 of a single one."""
    count = len(influence)
    return count / (count - 1) * float(np.sum(influence**2)) if count > 1 else 0.0


def _spread(tiles: OutcomeCounts, kind: Kind, match: str, unknown: float) -> float:
    """Gives the root of the mean variance of repeats; `unknown` where nothing has repeats."""
    rates: dict[tuple[str, str, str], list[float]] = {}
    for key, counts in tiles.series.items():
        repeat = repeat_of(key.camouflage)
        rate = float(overall_attack_success_rate(counts[:, 1:].sum(axis=0)))
        if repeat.kind == kind and key.match == match and not math.isnan(rate):
            rates.setdefault((repeat.of, key.renderer, key.detector), []).append(rate)
    variances = [np.var(each, ddof=1) for each in rates.values() if len(each) > 1]
    return min(float(np.sqrt(np.mean(variances))), 1.0) if variances else unknown


def _unit_variance(easr: float, gained: float) -> float:
    """Gives the variance of EASR times the vehicles found before, were they independent."""
    lost = easr + gained
    return (1 - lost) * easr**2 + lost * (1 - easr) ** 2 + gained
