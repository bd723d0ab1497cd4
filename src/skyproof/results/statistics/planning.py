"""How wide the interval of a planned test will be, and how many tiles a wanted width takes."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from msgspec import Meta

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.ranges import Fraction, check_ranges
from skyproof.results.pairs.counts import OutcomeCounts
from skyproof.results.statistics.intervals import effective_limits, unanimous_margin
from skyproof.results.statistics.sample import Sample

_MOST_TILES = 10**9


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
        vehicle_correlation: correlation of one vehicle's fates on different tiles.
    """

    easr: Fraction
    vehicles_per_tile: Annotated[float, Meta(gt=0, le=1e6)] = 9.0
    found_before: Annotated[float, Meta(gt=0, le=1)] = 1.0
    design_effect: Annotated[float, Meta(ge=1, le=1e6)] = 1.8
    fleet: Annotated[int, Meta(ge=1, le=10**6)] = 32
    vehicle_correlation: Fraction = 0.05

    def __post_init__(self) -> None:
        check_ranges(self)


def tiles_needed(half_width: float, assumptions: Assumptions) -> int | None:
    """Gives the fewest tiles whose 95 % interval of EASR is expected to be ± `half_width` or less.

    None where no number of tiles is enough, because the fleet is too small.
    """
    if expected_half_width(_MOST_TILES, assumptions) > half_width:
        return None
    enough = 2
    while expected_half_width(enough, assumptions) > half_width:
        enough *= 2
    few = enough // 2
    while enough - few > 1:
        middle = (few + enough) // 2
        if middle >= 2 and expected_half_width(middle, assumptions) <= half_width:
            enough = middle
        else:
            few = middle
    return enough


def tiles_to_show(needed: int, scenes: int) -> int:
    """Gives the tiles of which this number of scenes, each on a tile drawn with replacement, shows
    `needed` on average. `needed` is below `scenes`.
    """
    tiles = needed
    while tiles * (1 - (1 - 1 / tiles) ** scenes) < needed:
        tiles += 1
    return tiles


def expected_half_width(tiles: int, assumptions: Assumptions) -> float:
    """Estimates half the width of the interval of EASR for one detector on this number of tiles.

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


def assume_from_pilot(pilot: OutcomeCounts, *, match: str = "centre_1m") -> Assumptions:
    """Estimates assumptions from a test: rates, vehicles a tile, share found and design effect.

    Rates, vehicles a tile and the share found are those of the least certain optimised camouflage
    and detector. The design effect is the median over all (jackknife variance over tiles over that
    of independent vehicles).

    Raises:
        ConfigurationError: the test has no optimised camouflage, fewer than three tiles, or nothing
            changed in it.
    """
    effects: list[float] = []
    series: list[tuple[float, Int[np.ndarray, "C 4"]]] = []
    for key, counts in pilot.series.items():
        _, both, lost, gained = (int(value) for value in counts.sum(axis=0))
        found = both + lost
        camouflage = CamouflageName.read(key.camouflage)
        if camouflage.random or camouflage.kept_copy or key.match != match or not found:
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
        by_tile = _clustered(sample.by_tile(influence[None, :, None]).ravel())
        effects.append(max(by_tile / independent, 1.0))
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


def _clustered(influence: Float[np.ndarray, " G"]) -> float:
    """Gives the variance of a sum of clusters' influences; 0 of a single one."""
    count = len(influence)
    return count / (count - 1) * float(np.sum(influence**2)) if count > 1 else 0.0


def _unit_variance(easr: float, gained: float) -> float:
    """Gives the variance of EASR times the vehicles found before, were they independent."""
    lost = easr + gained
    return (1 - lost) * easr**2 + lost * (1 - easr) ** 2 + gained
