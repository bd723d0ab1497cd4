"""Planning of tests: widths of intervals, chances of a decision, and the tiles that both need."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.results.outcomes import OutcomeCounts
from skyproof.results.statistics.acceptance import (
    MOST_IN_SCENE,
    USUAL_IN_SCENE,
    Requirement,
    Tiles,
    evidence_above,
    evidence_below,
    fewest,
)
from skyproof.results.statistics.intervals import Sample, effective_limits, unanimous_margin

_MOST_TILES = 10**9
_MOST_TRIALS = 20_000
_RUNS = 400
_DECIDED = 0.9


@dataclass(frozen=True)
class Assumptions:
    """Expectations on a test with one detector and one attack.

    Attributes:
        easr: overall attack success rate, without vehicles found only with the camouflage.
        vehicles_per_tile: vehicles in sight per background tile.
        found_before: share of them that the detector finds without camouflage.
        design_effect: variance over that with independent vehicles: 1 + (m − 1)ρ for m found
            vehicles a tile with intra-tile correlation ρ.
        fleet: number of different vehicles, each of which stands on many tiles; with 1 the interval
            applies to this vehicle.
        vehicle_correlation: correlation of one vehicle's outcomes on different tiles.
    """

    easr: float
    vehicles_per_tile: float = 9.0
    found_before: float = 1.0
    design_effect: float = 1.8
    fleet: int = 32
    vehicle_correlation: float = 0.05


@dataclass(frozen=True)
class DecisionChances:
    """The chances of acceptance and rejection by the share lost; the rest is undecided."""

    shares: Float[np.ndarray, " S"]
    accepted: Float[np.ndarray, " S"]
    rejected: Float[np.ndarray, " S"]


def tiles_needed(half_width: float, assumptions: Assumptions) -> int | None:
    """Returns the fewest tiles for an interval of ± `half_width`; None if no number is enough."""
    if expected_half_width(_MOST_TILES, assumptions) > half_width:
        return None
    return fewest(lambda tiles: expected_half_width(tiles, assumptions) <= half_width, 2)


def tiles_to_decide(requirement: Requirement, assumptions: Assumptions) -> int:
    """Returns the tiles on which nine of ten tests decide rightly, as `chances_on_tiles` simulates.

    The detector loses as much as `accept`, or as `reject`, whichever needs more. More than 20,000
    tiles are refused.
    """

    def enough(tiles: int) -> bool:
        if tiles > _MOST_TRIALS:
            raise ConfigurationError(
                f"On no {_MOST_TRIALS:,} tiles do nine of ten tests decide between "
                f"{100 * requirement.accept:g} % and {100 * requirement.reject:g} %; set the two "
                "shares farther apart."
            )
        accepted, _ = _chances(requirement, assumptions, tiles, requirement.accept)
        if accepted < _DECIDED:
            return False
        _, rejected = _chances(requirement, assumptions, tiles, requirement.reject)
        return rejected >= _DECIDED

    return fewest(enough, 4, 50)


def tiles_to_show(needed: int, scenes: int) -> int:
    """Returns the tiles to draw from so that the scenes show `needed` different ones on average.

    Each scene draws its tile with replacement, and `needed` is below `scenes`.
    """
    return fewest(lambda tiles: tiles * (1 - (1 - 1 / tiles) ** scenes) >= needed, needed)


def expected_half_width(tiles: int, assumptions: Assumptions) -> float:
    """Estimates half the width of the 95 % interval of EASR for one detector.

    The variance of EASR is that of a ratio, linearised: of the vehicles found before, a share EASR
    is lost (influence 1 − EASR) and the rest kept (−EASR). It is multiplied by the design effect,
    and vehicles add their correlated part of it.
    """
    easr = assumptions.easr
    unit = _unit_variance(easr, 0.0)
    found = tiles * assumptions.vehicles_per_tile * assumptions.found_before
    by_tiles = unit * assumptions.design_effect / found
    several = assumptions.fleet > 1
    by_vehicles = unit * assumptions.vehicle_correlation / assumptions.fleet if several else 0.0
    variance = by_tiles + by_vehicles
    if variance < 1e-15:
        margin = unanimous_margin(min(tiles, assumptions.fleet) if several else tiles)
        return (min(easr + margin, 1.0) - (easr - margin)) / 2
    degrees = tiles - 1.0
    if by_vehicles:
        share = by_vehicles / variance
        degrees = 1 / ((1 - share) ** 2 / degrees + share**2 / (assumptions.fleet - 1))
    low, high = effective_limits(easr, variance, degrees)
    return (high - low) / 2


def assume_from_pilot(pilot: OutcomeCounts) -> Assumptions:
    """Estimates assumptions from a test: rates, vehicles a tile, share found and design effect.

    Rates, vehicles a tile and the share found are those of the least certain optimised camouflage
    and detector. The design effect is the median over all (jackknife variance over tiles over that
    of independent vehicles).
    """
    effects: list[float] = []
    series: list[tuple[float, Int[np.ndarray, "C 4"]]] = []
    for key, counts in pilot.series.items():
        _, both, lost, gained = (int(value) for value in counts.sum(axis=0))
        found = both + lost
        camouflage = CamouflageName.read(key.camouflage)
        if camouflage.random or camouflage.kept_copy or key.match != "centre_1m" or not found:
            continue
        seen = counts[:, 0] > 0
        cells = [cell for cell, here in zip(pilot.cells, seen, strict=True) if here]
        sample = Sample.draw(cells, generator=np.random.default_rng(0), replicates=1)
        shown = sample.by_tile(counts[seen][None])[0]
        easr = (lost - gained) / found
        independent = _unit_variance(easr, gained / found) / found
        if len(shown) < 3 or independent <= 1e-15:
            continue
        influence = counts[seen] @ np.array([0.0, -easr, 1 - easr, -1.0]) / found
        by_tile = sample.by_tile(influence[None, :, None]).ravel()
        clustered = len(shown) / (len(shown) - 1) * float(np.sum(by_tile**2))
        effects.append(max(clustered / independent, 1.0))
        series.append((independent * found, shown))
    if not series:
        raise ConfigurationError(
            "The pilot tells nothing about precision: expected is an optimised camouflage on at "
            "least three tiles that hides some vehicles and not all."
        )
    _, shown = max(series, key=lambda candidate: candidate[0])
    vehicles, both, lost, gained = (int(value) for value in shown.sum(axis=0))
    return Assumptions(
        easr=min(max((lost - gained) / (both + lost), 0.0), 1.0),
        vehicles_per_tile=vehicles / len(shown),
        found_before=(both + lost) / vehicles,
        design_effect=float(np.median(effects)),
    )


def chances_on_tiles(
    requirement: Requirement, assumptions: Assumptions, tiles: int
) -> DecisionChances:
    """Simulates the operating characteristic of a test with one attack.

    Tiles show one scene or more by a Poisson distribution, and these 1 to 5 vehicles. Each is found
    before by chance. The rates of tiles have a beta distribution with the correlation of the design
    effect.
    """
    shares = np.linspace(0.0, 1.0, 41)
    chances = [_chances(requirement, assumptions, tiles, float(share)) for share in shares]
    return DecisionChances(shares, *np.array(chances).T)


def _chances(
    requirement: Requirement, assumptions: Assumptions, tiles: int, share: float
) -> tuple[float, float]:
    """Returns the chances of acceptance and of rejection of a detector that loses this share."""
    generator = np.random.default_rng(0)
    found_per_tile = assumptions.vehicles_per_tile * assumptions.found_before
    correlation = (assumptions.design_effect - 1) / max(found_per_tile - 1, 1e-9)
    certainty = 1 / min(max(correlation, 1e-6), 1 - 1e-6) - 1
    # A beta distribution has no rate of exactly 0 or 1.
    inside = min(max(share, 1e-9), 1 - 1e-9)
    shape = (_RUNS, tiles)
    usual = max(assumptions.vehicles_per_tile / USUAL_IN_SCENE, 1.0)
    scenes = 1 + generator.poisson(usual - 1, shape)
    further = (max(assumptions.vehicles_per_tile / usual, 1.0) - 1) / (MOST_IN_SCENE - 1)
    shown = scenes + generator.binomial(scenes * (MOST_IN_SCENE - 1), further)
    found = generator.binomial(shown, assumptions.found_before)
    rate = generator.beta(inside * certainty, (1 - inside) * certainty, shape)
    simulated = Tiles(scenes, found, generator.binomial(found, rate))
    accepted = evidence_below(simulated, requirement.reject) >= 1 / requirement.consumer_risk
    rejected = evidence_above(simulated, requirement.accept) >= 1 / requirement.producer_risk
    return float(accepted.mean()), float((rejected & ~accepted).mean())


def _unit_variance(easr: float, gained: float) -> float:
    """Returns the variance of EASR times the vehicles found before, as if independent."""
    lost = easr + gained
    return (1 - lost) * easr**2 + lost * (1 - easr) ** 2 + gained
