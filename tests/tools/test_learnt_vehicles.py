"""What tools/learnt_vehicles.py measures, on points whose answer is known and on small renders."""

import json

import numpy as np
import pytest
from learnt_vehicles import LearntVehicles, density_and_coverage, vendi_score


def features(count, seed, dimensions=8):
    return np.random.default_rng(seed).normal(size=(count, dimensions))


def test_density_and_coverage_are_what_they_are_defined_as():
    real, made = features(60, 0), features(40, 1)
    radii = [np.sort(np.linalg.norm(real - one, axis=1))[5] for one in real]
    within = [
        [np.linalg.norm(one - other) < radius for other in made]
        for one, radius in zip(real, radii, strict=True)
    ]
    density = np.sum(within) / (5 * len(made))
    coverage = np.mean([any(row) for row in within])
    assert density_and_coverage(real, made) == pytest.approx((density, coverage))


def test_made_ones_elsewhere_cover_nothing_and_one_cluster_covers_its_own():
    real = np.concatenate([features(50, 0), features(50, 1) + 100])
    assert density_and_coverage(real, real + 1000) == (0.0, 0.0)
    _, coverage = density_and_coverage(real, features(200, 2))
    assert 0.4 < coverage <= 0.5
    assert density_and_coverage(real, real)[1] == 1.0


def test_the_vendi_score_counts_kinds():
    kinds = np.eye(6)
    assert vendi_score(np.repeat(kinds[:1], 9, axis=0)) == pytest.approx(1)
    assert vendi_score(np.repeat(kinds, 7, axis=0)) == pytest.approx(6)
    uneven = np.concatenate([np.repeat(kinds[:1], 9, axis=0), kinds[1:2]])
    assert vendi_score(uneven) == pytest.approx(np.exp(-0.9 * np.log(0.9) - 0.1 * np.log(0.1)))


def test_the_tool_writes_what_it_found(world):
    tool = LearntVehicles(
        world / "tiles",
        world / "cleared",
        (world / "first", world / "second"),
        world / "fleets.json",
    )
    record = tool.run()
    assert json.loads((world / "fleets.json").read_text()) == record
    assert list(record) == [str(world / "first"), str(world / "second")]
    for row in record.values():
        # Red rectangles are all alike, and no catalogue paint looks like them.
        assert row["coverage"] < 0.5 < row["real_coverage"]
        assert row["vendi"] > row["real_vendi"]
