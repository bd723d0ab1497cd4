"""Simulated tests whose true rates are known: how often do their intervals hold these?

python -m tests.results.simulated RUNS
"""

import math
import sys
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy import optimize, special

from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import Sample, resample
from skyproof.results.statistics.repeats import DRAWS, GIVEN, SEEDS, TRAININGS, Repeat, RepeatKind

REPLICATES = 400
_POINTS, _WEIGHTS = np.polynomial.hermite_e.hermegauss(101)


@dataclass(frozen=True)
class Side:
    """A camouflage, learnt or drawn, before one detector or several.

    Attributes:
        rate: mean over tiles, vehicles and repeats of the share that is lost.
        repeats: how many.
        repeat_sd: standard deviation of their rates.
        kind: what sort of repeats; by default seeds, and a single one stands for itself.
        detectors: which share the repeats' rates, and nothing of what single vehicles do.
        trainings: of the detectors. Seeds are each training's own, all trainings judge the same
            draws.
        training_sd: standard deviation of the trainings' rates.
    """

    rate: float
    repeats: int = 1
    repeat_sd: float = 0.0
    kind: RepeatKind | None = None
    detectors: int = 1
    trainings: int = 1
    training_sd: float = 0.0

    @property
    def series(self):
        """Training, repeat and detector of every series."""
        return list(product(range(self.trainings), range(self.repeats), range(self.detectors)))

    def repeats_of(self, of, training, repeat):
        """What a series is one of, as results say it: seeds lie within trainings."""
        kind = self.kind or (SEEDS if self.repeats > 1 else GIVEN)
        own = Repeat(of, str(repeat), kind)
        if self.trainings == 1:
            return [own]
        within = [] if kind == SEEDS else [own]
        return [*within, Repeat("detectors", str(training), TRAININGS)]


@dataclass(frozen=True)
class World:
    """What is simulated: one side, or the first minus the second.

    Attributes:
        sides: which.
        tiles, fleet: how many; 2 to 11 vehicles of the fleet stand on a tile.
        tile_sd, vehicle_sd: standard deviation of the rate from tile to tile and vehicle to
            vehicle.
        correlation: instead of both, the intra-tile correlation of rates of a beta distribution.
        shared: which part of how a tile differs is common to all series.
        gained: share of the vehicles missed before that are found after.
    """

    sides: tuple[Side, ...]
    tiles: int = 40
    fleet: int = 32
    tile_sd: float = 0.2
    vehicle_sd: float = 0.0
    correlation: float = field(default=0.0, kw_only=True)
    shared: float = field(default=1.0, kw_only=True)
    gained: float = field(default=0.0, kw_only=True)

    @property
    def truth(self):
        rates = [side.rate - self.gained / 9 for side in self.sides]
        return rates[0] - sum(rates[1:])


def coverage(world, *, runs, seed):
    """The share of simulated tests whose interval holds the truth, and the intervals' mean width.

    One vehicle in ten is missed before.
    """
    rng = np.random.default_rng(seed)
    held, widths = 0, []
    scales = [_scales(world, side) for side in world.sides]
    for run in range(runs):
        if run % 20 == 0:
            weights = resample(world.tiles, generator=rng, replicates=REPLICATES)
        tile, vehicle, cell = _places(rng, world)
        sample = Sample(*_cells(tile, vehicle, cell), weights)
        shared = (rng.normal(size=world.tiles), rng.normal(size=world.fleet))
        groups = [
            Group(
                _counts(rng, _rates(rng, world, side, scale, shared, tile, vehicle), cell, world),
                sample,
                [
                    side.repeats_of(str(number), training, repeat)
                    for training, repeat, _ in side.series
                ],
            )
            for number, (side, scale) in enumerate(zip(world.sides, scales, strict=True))
        ]
        if len(groups) == 1:
            interval = mean_interval(groups[0])
        else:
            interval = difference_interval(groups[:1], groups[1:])
        held += interval.low <= world.truth <= interval.high
        widths.append(interval.high - interval.low)
    return held / runs, float(np.mean(widths))


def _places(rng, world):
    """Tile and vehicle of everything in sight, and the number of its cell."""
    tile = np.repeat(np.arange(world.tiles), rng.integers(2, 12, world.tiles))
    vehicle = rng.integers(0, world.fleet, len(tile))
    _, vehicle = np.unique(vehicle, return_inverse=True)
    _, cell = np.unique(tile * world.fleet + vehicle, return_inverse=True)
    return tile, vehicle, cell


def _cells(tile, vehicle, cell):
    _, first = np.unique(cell, return_index=True)
    return tile[first], vehicle[first]


def _rates(rng, world, side, scales, shared, tile, vehicle):
    """The probability that each vehicle is lost: `[S, M]`."""
    tiles, vehicles = shared
    own = rng.normal(size=(len(side.series), world.tiles))
    tiles = math.sqrt(world.shared) * tiles + math.sqrt(1 - world.shared) * own
    if world.correlation:
        spread = (1 - world.correlation) / world.correlation
        ends = (side.rate * spread, (1 - side.rate) * spread)
        return special.betaincinv(*ends, special.ndtr(tiles))[:, tile]
    by_training, by_repeat, by_tile, by_vehicle = scales
    middle = special.ndtri(side.rate) * math.sqrt(1 + sum(scale**2 for scale in scales))
    training, repeat, _ = np.array(side.series).T
    seeds_lie_within = 0 if side.kind == DRAWS else training
    repeats = rng.normal(size=(side.trainings, side.repeats))[seeds_lie_within, repeat]
    trainings = rng.normal(size=side.trainings)[training] if by_training else 0 * repeats
    places = by_tile * tiles[:, tile] + by_vehicle * vehicles[vehicle]
    return special.ndtr(middle + (by_repeat * repeats + by_training * trainings)[:, None] + places)


def _scales(world, side):
    """On the normal scale, how much trainings, repeats, tiles and vehicles move the rate."""
    if world.correlation:
        return []
    sds = (side.training_sd, side.repeat_sd, world.tile_sd, world.vehicle_sd)
    return [_scale(sd, side.rate) for sd in sds]


def _scale(sd, rate):
    """By how much a standard normal is multiplied so that Φ of it has this mean and spread."""

    def excess(scale):
        rates = special.ndtr(special.ndtri(rate) * math.sqrt(1 + scale**2) + scale * _POINTS)
        return math.sqrt(np.average((rates - rate) ** 2, weights=_WEIGHTS)) - sd

    return optimize.brentq(excess, 0, 50) if sd else 0.0


def _counts(rng, rates, cell, world):
    """What is found before and after, by cell: `[S, N, 3]`."""
    # A detector finds the same vehicles before, whatever is then painted on them.
    found = rng.random(len(cell)) < 0.9
    lost = found & (rng.random(rates.shape) < rates)
    gained = ~found & (rng.random(rates.shape) < world.gained)
    columns = np.stack([found & ~lost, lost, gained], axis=-1).astype(np.int64)
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(cell.max() + 1))
    return np.add.reduceat(columns[:, order], starts, axis=1)


def _before(rate, gained=0.0, **given):
    return World((Side(rate),), gained=gained, **given)


WIDE = Side(0.4, 30, 0.4, DRAWS)
FEW = Side(0.2, 3, 0.2, DRAWS)
LEARNT = Side(0.8, 3, 0.1)
TRAINED = Side(0.8, trainings=3, training_sd=0.1)

WORLDS = {
    "40 tiles, 0.5": _before(0.5, correlation=0.2),
    "40 tiles, 0.85": _before(0.85, correlation=0.2),
    "40 tiles, 0.05": _before(0.05, correlation=0.1),
    "15 tiles, 0.7": _before(0.7, tiles=15, correlation=0.2),
    # Nearly all vehicles of very unlike tiles are lost: a few tiles decide.
    "40 tiles, 0.97": _before(0.97, correlation=0.2),
    "15 tiles, 0.9": _before(0.9, tiles=15, correlation=0.2),
    "100 tiles, 0.97": _before(0.97, tiles=100, correlation=0.2),
    # What a random control looks like: some lost, some gained.
    "40 tiles, 0.05 with gains": _before(0.05, 0.2, correlation=0.1),
    "net, 40 tiles, 0.8 - 0.1": World(
        (Side(0.8), Side(0.1)), correlation=0.2, shared=0.5, gained=0.1
    ),
    "net, 15 tiles, 0.97 - 0.05": World(
        (Side(0.97), Side(0.05)), tiles=15, correlation=0.2, shared=0.5, gained=0.1
    ),
    "mean of 9 series, 40 tiles, 0.9": World(
        (Side(0.9, detectors=9),), correlation=0.2, shared=0.7, gained=0.05
    ),
    "mean of 9 series, 15 tiles, 0.7": World(
        (Side(0.7, detectors=9),), tiles=15, correlation=0.2, shared=0.7, gained=0.05
    ),
    "mean of 9 series, 40 tiles, 0.97": World(
        (Side(0.97, detectors=9),), correlation=0.2, shared=0.7, gained=0.05
    ),
    "vehicle SD 0.3, 0.5": World((Side(0.5),), vehicle_sd=0.3),
    "vehicle SD 0.3, 0.8": World((Side(0.8),), vehicle_sd=0.3),
    "3 seeds of SD 0.1, 0.8": World((LEARNT,)),
    "3 seeds of SD 0.1, 0.9, 100 like tiles": World((Side(0.9, 3, 0.1),), 100, tile_sd=0.05),
    "30 draws of SD 0.4": World((WIDE,)),
    "3 draws of SD 0.2": World((FEW,)),
    "net of 30 draws, all together": World((LEARNT, WIDE), vehicle_sd=0.3),
    "net of 3 draws, all together": World((LEARNT, FEW), vehicle_sd=0.3),
    "3 trainings of SD 0.1, 0.8": World((TRAINED,)),
    "3 trainings of SD 0.1, 0.9, 100 like tiles": World(
        (Side(0.9, trainings=3, training_sd=0.1),), 100, tile_sd=0.05
    ),
    "3 trainings of SD 0.1 with 3 seeds of SD 0.1 each, 0.8": World(
        (Side(0.8, 3, 0.1, trainings=3, training_sd=0.1),)
    ),
    "net of 10 draws before 3 trainings": World(
        (TRAINED, Side(0.2, 10, 0.1, DRAWS, trainings=3, training_sd=0.05)), vehicle_sd=0.3
    ),
}

STARTS = {
    f"{count} of starts of SD {sd:g}, {rate:g}": World(
        (Side(rate, count, sd, SEEDS),), 37, tile_sd=0.12, vehicle_sd=0.05
    )
    for rate in (0.9, 0.5)
    for sd in (0.0, 0.015, 0.03, 0.1)
    for count in (1, 3, 5)
    if count > 1 or sd <= SEEDS.largest_sd
}
"""One to five starts that differ as on attacked detectors, or several that differ as elsewhere."""

STUDIED = {
    "1 of starts of SD 0.1, 0.9": World(
        (Side(0.9, 1, 0.1, SEEDS),), 37, tile_sd=0.12, vehicle_sd=0.05
    ),
    "vehicle SD 0.3, 0.8, fleet of 8": World((Side(0.8),), fleet=8, vehicle_sd=0.3),
    "vehicle SD 0.3, 0.5, fleet of 8": World((Side(0.5),), fleet=8, vehicle_sd=0.3),
    "3 seeds of SD 0.1, 0.5, 100 like tiles": World((Side(0.5, 3, 0.1),), 100, tile_sd=0.05),
    "3 seeds of SD 0.02, 0.9": World((Side(0.9, 3, 0.02),)),
    "2 seeds of SD 0.1, 0.8": World((Side(0.8, 2, 0.1),)),
    "10 draws of SD 0.4": World((Side(0.4, 10, 0.4, DRAWS),)),
    "10 draws of SD 0.38, 0.2": World((Side(0.2, 10, 0.38, DRAWS),)),
    "30 draws of SD 0.38, 0.2": World((Side(0.2, 30, 0.38, DRAWS),)),
    "3 draws of SD 0.38, 0.2": World((Side(0.2, 3, 0.38, DRAWS),)),
    "30 draws of SD 0.02, 0.1": World((Side(0.1, 30, 0.02, DRAWS),)),
    "3 trainings of SD 0.1, 0.5, 100 like tiles": World(
        (Side(0.5, trainings=3, training_sd=0.1),), 100, tile_sd=0.05
    ),
    "3 trainings of SD 0.15, 0.7, 100 like tiles": World(
        (Side(0.7, trainings=3, training_sd=0.15),), 100, tile_sd=0.05
    ),
    "3 trainings of SD 0.2, 0.7": World((Side(0.7, trainings=3, training_sd=0.2),)),
    "3 trainings of SD 0.2, 0.7, 100 like tiles": World(
        (Side(0.7, trainings=3, training_sd=0.2),), 100, tile_sd=0.05
    ),
    "3 trainings of SD 0.03, 0.9": World((Side(0.9, trainings=3, training_sd=0.03),)),
    "2 trainings of SD 0.1, 0.8": World((Side(0.8, trainings=2, training_sd=0.1),)),
    "3 trainings of SD 0.1, 3 detectors, 0.8": World(
        (Side(0.8, detectors=3, trainings=3, training_sd=0.1),)
    ),
}
"""Beyond what every run of the tests asks."""


if __name__ == "__main__":
    for name, world in (WORLDS | STARTS | STUDIED).items():
        held, width = coverage(world, runs=int(sys.argv[1]), seed=3)
        print(f"| {name} | {100 * held:.1f} % | {width:.3f} |", flush=True)
