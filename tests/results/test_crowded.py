"""The promise is about vehicles: both risks hold where crowded places lose more, or fewer."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import special

from skyproof.results.statistics.acceptance import Tiles, evidence_above, evidence_below

RUNS = 1000
RISK = 0.05
# Three standard errors of 1,000 runs are 2.1 points.
ALLOWED = RISK + 3 * (RISK * (1 - RISK) / RUNS) ** 0.5


@dataclass(frozen=True)
class Places:
    """Scenes on tiles drawn at random; 1 to `most` vehicles each, of which crowded ones differ.

    Attributes:
        tiles, scenes: how many; each tile shows one scene where there are as many.
        correlation: of the fates of one tile's vehicles.
        sparse: what sparse scenes lose, as a multiple of what the vehicles lose together.
        few: vehicles of a sparse scene, at most.
    """

    tiles: int
    correlation: float
    sparse: float = 1.0
    scenes: int = 0
    most: int = 15
    few: int = 7


SETTINGS = {
    "12 alike": Places(12, 0.1),
    "12, crowded lose more": Places(12, 0.5, 0.2),
    "37, crowded lose more": Places(37, 0.1, 0.2),
    "37, crowded lose fewer": Places(37, 0.5, 1.8),
    "37, all or none on a tile": Places(37, 0.9, 0.2),
    "150 alike": Places(150, 0.5),
    "150, crowded lose more": Places(150, 0.1, 0.2),
    "150, crowded lose fewer": Places(150, 0.9, 1.8),
    "40 tiles of 120 scenes": Places(40, 0.1, 0.6, scenes=120, most=5, few=3),
    "12 tiles of 120 scenes": Places(12, 0.5, 0.6, scenes=120, most=5, few=3),
    "83 tiles of 120 scenes": Places(83, 0.9, 1.5, scenes=120, most=5, few=3),
}


def simulate(places, share, runs=RUNS, seed=0):
    """Tests of a detector that loses this share of the vehicles."""
    generator = np.random.default_rng(seed)
    many = places.scenes or places.tiles
    tile = np.broadcast_to(np.arange(places.tiles), (runs, places.tiles))
    if places.scenes:
        tile = generator.integers(places.tiles, size=(runs, places.scenes))
    numbers = np.arange(1, places.most + 1)
    sparse = numbers <= places.few
    # Crowded ones lose as much more or less as leaves the share of all.
    part = numbers[sparse].sum() / numbers.sum()
    times = min(places.sparse, 0.98 / share)
    rate = share * np.where(sparse, times, (1 - part * times) / (1 - part))
    vehicles = generator.integers(1, places.most + 1, (runs, many))
    certainty = 1 / places.correlation - 1
    # Vehicles of one tile fare alike: its luck is one.
    luck = generator.random((runs, places.tiles))
    mean = rate[vehicles - 1]
    own = special.betaincinv(
        mean * certainty, (1 - mean) * certainty, np.take_along_axis(luck, tile, axis=1)
    )
    lost = generator.binomial(vehicles, own)
    sums = np.zeros((3, runs, places.tiles), dtype=np.int64)
    at = np.arange(runs)[:, None]
    for total, each in zip(sums, (np.ones_like(vehicles), vehicles, lost), strict=True):
        np.add.at(total, (at, tile), each)
    # Tiles without a scene are no part of a test, and here tell nothing.
    return Tiles(np.maximum(sums[0], 1), sums[1], sums[2], places.most)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.75])
@pytest.mark.parametrize("name", SETTINGS)
def test_both_risks_hold_for_vehicles(name, share):
    tiles = simulate(SETTINGS[name], share)
    assert tiles.share == pytest.approx(share, abs=0.02)
    assert (evidence_below(tiles, share) >= 1 / RISK).mean() <= ALLOWED
    assert (evidence_above(tiles, share) >= 1 / RISK).mean() <= ALLOWED


def crowded_and_sparse(seed=3):
    """A third of the tiles show 9 to 14 vehicles and lose 42 %, the others 1 to 3, and 7 %."""
    generator = np.random.default_rng(seed)
    crowded = generator.random((RUNS, 37)) < 0.35
    found = np.where(
        crowded, generator.integers(9, 15, crowded.shape), generator.integers(1, 4, crowded.shape)
    )
    lost = generator.binomial(found, np.where(crowded, 0.42, 0.07))
    return Tiles(np.ones_like(found), found, lost, 14)


def test_a_third_of_the_vehicles_is_no_fifth_of_them():
    """The share of vehicles is 33 %, and the mean of the tiles' shares 19 %."""
    tiles = crowded_and_sparse()
    assert tiles.share == pytest.approx(0.334, abs=0.01)
    assert (evidence_below(tiles, 0.3) >= 20).mean() <= 0.01
    assert (evidence_below(tiles, 0.33) >= 20).mean() <= RISK
    # Stakes by the vehicles in sight would promise the mean of the tiles.
    of_tiles = replace(tiles, scenes=tiles.found, most=1)
    assert (evidence_below(of_tiles, 0.3) >= 20).mean() > 0.2


@pytest.mark.parametrize(("share", "least"), [(0.05, 0.99), (0.1, 0.95), (0.15, 0.65), (0.2, 0.15)])
def test_a_test_of_the_usual_size_decides(share, least):
    """120 scenes on 40 tiles: nearly as often as a test of the mean of the tiles."""
    tiles = simulate(Places(40, 0.1, scenes=120, most=5, few=3), share)
    assert (evidence_below(tiles, 0.3) >= 20).mean() >= least
