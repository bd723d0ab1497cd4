"""Says how many test vehicles a wanted precision needs.

The answer comes from assumptions, or from a pilot evaluation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Int
from msgspec import Meta

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.ranges import check_ranges
from skyproof.results.pairs.tiles import TileCounts
from skyproof.results.statistics.intervals import effective_limits, unanimous_margin

__all__ = ["Assumptions", "Need", "assume_from_pilot", "expected_half_width", "vehicles_needed"]

SMALLEST = 0.001


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
    """

    easr: Annotated[float, Meta(ge=-1, le=1)]
    enhancement_rate: Annotated[float, Meta(ge=0, le=2)] = 0.0
    vehicles_per_tile: Annotated[float, Meta(gt=0, le=1e6)] = 9.0
    found_before: Annotated[float, Meta(gt=0, le=1)] = 1.0
    design_effect: Annotated[float, Meta(ge=1, le=1e6)] = 1.8

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
        ConfigurationError: the half-width is not in [0.001, 1).
    """
    if not SMALLEST <= half_width < 1:
        raise ConfigurationError(
            f"The half-width expects a fraction from {SMALLEST} to below 1, got {half_width:g}."
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


def expected_half_width(tiles: int, assumptions: Assumptions) -> float:
    """Expects half the width of the interval that `cluster_interval` gives, about.

    It holds for one detector with so many tiles. The variance of EASR is that of a ratio,
    linearised: of the vehicles found before, a share ASR is lost (influence 1 − EASR) and the rest
    kept (−EASR), and ER as many are gained (−1). That is multiplied by the design effect.
    """
    easr = assumptions.easr
    gained = assumptions.enhancement_rate
    variance = _unit_variance(easr, gained) * assumptions.design_effect
    variance /= tiles * assumptions.vehicles_per_tile * assumptions.found_before
    if variance < 1e-15:
        margin = unanimous_margin(tiles)
        return (min(easr + margin, 1.0) - (easr - margin)) / 2
    low, high = effective_limits(easr, variance, tiles - 1.0)
    return (high - low) / 2


def assume_from_pilot(tiles: TileCounts, *, match: str = "centre_1m") -> tuple[Assumptions, str]:
    """Takes assumptions from a pilot evaluation: its least certain learnt camouflage and detector.

    Rates, vehicles a tile and the share found before are that series' own. The design effect, which
    a pilot tells only roughly, is the median over all series (jackknife variance over tiles against
    that of independent vehicles).

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
    series: list[tuple[float, str, Int[np.ndarray, "C 4"]]] = []
    for key, counts in tiles.series.items():
        shown = counts[counts[:, 0] > 0]
        total = shown.sum(axis=0)
        found = int(total[1] + total[2])
        if (
            CamouflageName.read(key.camouflage).random
            or key.match != match
            or len(shown) < 3
            or not found
        ):
            continue
        easr = float((total[2] - total[3]) / found)
        gained = float(total[3] / found)
        independent = _unit_variance(easr, gained) / found
        if independent <= 1e-15:
            continue
        influence = (shown[:, 2] - shown[:, 3]) - easr * (shown[:, 1] + shown[:, 2])
        clustered = len(shown) / (len(shown) - 1) * float(np.sum(influence**2)) / found**2
        effects.append(max(clustered / independent, 1.0))
        series.append((independent * found, f"{key.camouflage} before {key.detector}", shown))
    if not series:
        raise ConfigurationError(
            "The pilot tells nothing about precision: expected is a learnt camouflage on at least "
            "three tiles that hides some vehicles and not all; give --easr and the rest yourself."
        )

    # The least certain series gives the rates.
    _, name, shown = max(series, key=lambda candidate: candidate[0])
    vehicles, both, lost, gone = (int(value) for value in shown.sum(axis=0))
    found = both + lost
    assumptions = Assumptions(
        easr=(lost - gone) / found,
        enhancement_rate=gone / found,
        vehicles_per_tile=vehicles / len(shown),
        found_before=found / vehicles,
        design_effect=float(np.median(effects)),
    )
    return assumptions, name


def _unit_variance(easr: float, gained: float) -> float:
    """Gives the variance of EASR times the vehicles found before, were they independent."""
    lost = easr + gained
    return (1 - lost) * easr**2 + lost * (1 - easr) ** 2 + gained
