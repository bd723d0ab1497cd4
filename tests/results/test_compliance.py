"""Simulated tests of a requirement, and the tiles that a decision takes."""

import numpy as np
import pytest

from skyproof.errors import ConfigurationError
from skyproof.results.statistics import planning
from skyproof.results.statistics.acceptance import (
    Requirement,
    Tiles,
    evidence_above,
    evidence_below,
)
from skyproof.results.statistics.planning import Assumptions, _chances, tiles_to_decide


def test_only_right_answers_count_and_tiles_without_a_found_vehicle_tell_nothing():
    requirement = Requirement(0.1, 0.3, 0.2, 0.2)
    assumptions = Assumptions(0.8, vehicles_per_tile=6.0, design_effect=1.5)
    tiles = tiles_to_decide(requirement, assumptions)
    good, bad = (_chances(requirement, assumptions, tiles, share) for share in (0.1, 0.3))
    assert good[0] >= 0.9
    assert bad[1] >= 0.9
    few = Assumptions(0.8, vehicles_per_tile=1.0, found_before=0.5)
    all_found = Assumptions(0.8, vehicles_per_tile=1.0, found_before=1.0)
    more, fewer = (tiles_to_decide(requirement, one) for one in (few, all_found))
    assert more == pytest.approx(2 * fewer, rel=0.2)


@pytest.mark.slow
def test_as_many_tiles_as_planned_decide(monkeypatch):
    requirement = Requirement(0.1, 0.3)
    assumptions = Assumptions(0.8, vehicles_per_tile=6.0, design_effect=1.5)
    tiles = tiles_to_decide(requirement, assumptions)
    generator = np.random.default_rng(5)
    for rate in (0.1, 0.3):
        scenes = 1 + generator.poisson(1, (500, tiles))
        found = scenes + generator.binomial(4 * scenes, 0.5)
        inside = generator.beta(rate * 9, (1 - rate) * 9, (500, tiles))
        seen = Tiles(scenes, found, generator.binomial(found, inside))
        decided = (evidence_below(seen, 0.3) >= 20) | (evidence_above(seen, 0.1) >= 20)
        assert decided.mean() >= 0.85
    assert tiles_to_decide(Requirement(0.1, 0.2), assumptions) > 2 * tiles
    # Simulating twenty thousand tiles would take most of this test's time.
    monkeypatch.setattr(planning, "_MOST_TRIALS", 1000)
    with pytest.raises(ConfigurationError, match=r"On no 1,000 tiles .* farther apart"):
        tiles_to_decide(Requirement(0.2, 0.201), assumptions)
