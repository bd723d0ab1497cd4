"""Planned tests, simulated."""

import math

import numpy as np
import pytest
from scipy import special

from skyproof.errors import ConfigurationError
from skyproof.results.outcomes import Series
from skyproof.results.statistics.intervals import (
    cluster_interval,
    overall_attack_success_rate,
    resample,
)
from skyproof.results.statistics.planning import (
    Assumptions,
    assume_from_pilot,
    expected_half_width,
    tiles_needed,
    tiles_to_show,
)
from tests.results.counted import on_tiles
from tests.results.simulated import Side, World, coverage


def easr(counts):
    return overall_attack_success_rate(counts).mean(axis=-1)


def simulate(rng, tiles, vehicles, asr, er, correlation):
    """Makes counts `[C, 4]` of tiles of `vehicles` each.

    Nine in ten are found before, and their fate is alike within a tile.
    """
    spread = (1 - correlation) / correlation
    found = rng.binomial(vehicles, 0.9, tiles)
    lost = rng.binomial(
        found, special.betaincinv(asr * spread, (1 - asr) * spread, rng.random(tiles))
    )
    gained = rng.binomial(vehicles - found, er * 9)
    return np.stack([np.full(tiles, vehicles), found - lost, lost, gained], axis=1)


@pytest.mark.parametrize(
    ("half_width", "rate", "correlation"), [(0.05, 0.8, 0.1), (0.1, 0.3, 0.05), (0.04, 0.93, 0.1)]
)
def test_the_planned_test_gives_the_wanted_half_width(half_width, rate, correlation, rng):
    assumed = Assumptions(rate, 9.0, 0.9, 1 + (9 * 0.9 - 1) * correlation, fleet=1)
    need = tiles_needed(half_width, assumed)
    weights, obtained = resample(need, generator=rng, replicates=1000), []
    for _ in range(60):
        counts = simulate(rng, need, 9, rate, 0.0, correlation)[None, :, 1:]
        interval = cluster_interval(counts, easr, weights, limits=(-math.inf, 1.0))
        obtained.append((interval.high - interval.low) / 2)
    assert np.median(obtained) == pytest.approx(half_width, rel=0.15)


def test_it_is_the_smallest_such_test():
    assumed = Assumptions(0.8, design_effect=1.5)
    need = tiles_needed(0.05, assumed)
    assert expected_half_width(need, assumed) <= 0.05 < expected_half_width(need - 1, assumed)


def test_by_hand():
    # 1.96² · 0.8 · 0.2 · 1.8 / 0.01² independent vehicles, and about 1 % for the limits being
    # exact.
    need = tiles_needed(0.01, Assumptions(0.8, design_effect=1.8, fleet=1))
    assert 9 * need == pytest.approx(11063, rel=0.03)
    # Where every vehicle is hidden: the lower limit 0.025 ** (1 / tiles) is 0.9 at 36 tiles, of as
    # many vehicles at least.
    assert tiles_needed(0.05, Assumptions(1.0, fleet=36)) == 36
    assert tiles_needed(0.05, Assumptions(1.0, fleet=34)) is None


def test_vehicles_count():
    # 0.8 · 0.2 · 0.05 by 32 vehicles, with 31 degrees of freedom, is left on any number of tiles.
    many = Assumptions(0.8, design_effect=1.0)
    # The limits are exact, and so a little wider.
    assert expected_half_width(10**7, many) == pytest.approx(
        2.0395 * (0.8 * 0.2 * 0.05 / 32) ** 0.5, rel=0.03
    )


def test_the_planned_test_with_a_fleet_gives_the_wanted_half_width():
    # Tiles and vehicles differ by standard deviations 0.2 and 0.15 of a rate of 0.7: correlations
    # of 0.04 / 0.21 and 0.0225 / 0.21, and 1 + 6.5 · 0.9 · 0.04 / 0.21 for 6.5 vehicles a tile,
    # more for tiles of unlike size (2 to 11).
    found = 0.9 * (6.5 + 8.25 / 6.5)
    assumed = Assumptions(0.7, 6.5, 0.9, 1 + (found - 1) * 0.04 / 0.21, 32, 0.0225 / 0.21)
    world = World((Side(0.7),), tiles=60, tile_sd=0.2, vehicle_sd=0.15)
    _, width = coverage(world, runs=60, seed=1)
    assert width / 2 == pytest.approx(expected_half_width(60, assumed), rel=0.15)


@pytest.mark.parametrize("tiles", [40, 75, 110])
def test_so_many_tiles_as_it_says_are_shown_by_the_scenes(tiles, rng):
    enough = tiles_to_show(tiles, 120)
    seen = [len(np.unique(rng.integers(enough, size=120))) for _ in range(400)]
    assert tiles - 0.5 < np.mean(seen) < tiles + 1.5


def test_a_pilot_tells_rates_and_design_effect(rng):
    counts = simulate(rng, 400, 9, 0.75, 0.05, 0.3)
    control = simulate(rng, 400, 9, 0.5, 0.0, 0.3)
    surer = simulate(rng, 400, 9, 0.95, 0.0, 0.3)
    names = {"T-U-0": counts, "R-U-0": control, "T-Pix-0": surer}
    series = {Series(name, "torch", "yolov5", "centre_1m"): each for name, each in names.items()}
    assumed = assume_from_pilot(on_tiles([f"t{i:03d}" for i in range(400)], series))
    assert assumed.easr == pytest.approx(0.70, abs=0.05)
    assert (assumed.vehicles_per_tile, assumed.found_before) == (9, pytest.approx(0.9, abs=0.02))
    assert assumed.design_effect == pytest.approx(1 + (8.1 - 1) * 0.3, rel=0.2)


def test_a_pilot_that_tells_nothing_is_refused():
    all_hidden = {Series("T-U", "torch", "a", "centre_1m"): np.tile([5, 0, 5, 0], (4, 1))}
    with pytest.raises(ConfigurationError, match="pilot tells nothing"):
        assume_from_pilot(on_tiles("abcd", all_hidden))
