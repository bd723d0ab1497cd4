"""EASR against practicality, by hand."""

import math

import numpy as np
import pytest

from skyproof.errors import ConfigurationError
from skyproof.reproduction.curves import p1_score, practicality_curves
from skyproof.results.outcomes import Series
from tests.results.counted import on_tiles


def made(lost, tiles=20, found=10):
    """Makes counts by (camouflage, detector).

    Every tile loses about `lost` of `found` vehicles.
    """
    series = {}
    for (camouflage, detector), share in lost.items():
        gone = np.full(tiles, round(share * found))
        # Half of the tiles lose one more, half one less, so that tiles differ.
        gone[::2], gone[1::2] = np.minimum(gone[::2] + 1, found), gone[1::2] - 1
        counts = np.stack([np.full(tiles, found), found - gone, gone, 0 * gone], axis=1)
        series[Series(camouflage, "torch", detector, "centre_1m")] = counts
    return on_tiles([f"t{i:02d}" for i in range(tiles)], series)


def test_p1_by_hand():
    # 2 · 0.9 · 0.6 / 1.5 = 0.72.
    assert float(p1_score(np.array(0.9), 0.6)) == pytest.approx(0.72)
    assert p1_score(np.array([-0.2, 0.0, 0.5, 0.5]), np.array([0.8, 0.8, 0.0, 0.5])).tolist() == [
        0,
        0,
        0,
        0.5,
    ]
    assert float(p1_score(np.array(-0.5), 0.5)) == 0
    assert math.isnan(float(p1_score(np.array(math.nan), 0.5)))
    assert float(p1_score(np.array(0.0), 0.0)) == 0


def test_a_combined_family_starts_at_its_texture():
    tiles = made(
        {
            ("T-Fc-0", "a"): 0.2,
            ("T-Fc-1", "a"): 0.4,
            ("C-Fc-seq@0.2-0", "a"): 0.8,
            ("C-Fc-seq@0.2-1", "a"): 0.6,
            ("C-Fc-seq@0.5-0", "a"): 0.9,
            ("C-Fc-par@0.2-0", "a"): 0.1,
            ("T-PixFc-0", "a"): 0.1,
            ("R-C-Fc@0.2-0", "a"): 0.1,
        }
    )
    curve = practicality_curves(tiles)["C-Fc-seq"]
    assert [point.perturbation_magnitude for point in curve.points] == [0.0, 0.2, 0.5]
    assert [point.easr.estimate for point in curve.points] == pytest.approx([0.3, 0.7, 0.9])
    expected = [2 * 0.3 / 1.3, 2 * 0.7 * 0.8 / 1.5, 2 * 0.9 * 0.5 / 1.4]
    assert [point.p1 for point in curve.points] == pytest.approx(expected)
    assert curve.best.perturbation_magnitude == 0.2
    assert curve.points[1].practicality == pytest.approx(0.8)
    assert sum(point.share_best for point in curve.points) == pytest.approx(1)
    assert curve.points[1].easr.low < 0.7 < curve.points[1].easr.high


def test_shape_alone_starts_at_nothing():
    tiles = made(
        {("S-O@0.4", "a"): 0.9, ("S-O@1", "a"): 0.9, ("S-O@0.4", "b"): 0.7, ("S-O@1", "b"): 0.9}
    )
    curve = practicality_curves(tiles)["S-O"]
    assert [(point.perturbation_magnitude, point.p1) for point in curve.points] == [
        (0.0, 0.0),
        (0.4, pytest.approx(2 * 0.8 * 0.6 / 1.4)),
        (1.0, 0.0),
    ]
    assert curve.best == curve.points[1]
    assert (curve.points[0].easr.estimate, curve.points[1].share_best) == (0.0, 1.0)


def test_the_best_magnitude_is_as_sure_as_the_replicates_agree():
    # P1 of 0.8 · 0.8 and 0.9 · 0.7 are close: 0.8 and 0.7875; those of 0.1 are not.
    tiles = made({("S-O@0.2", "a"): 0.8, ("S-O@0.3", "a"): 0.9, ("S-O@0.9", "a"): 0.9}, tiles=8)
    shuffled = tiles.series[Series("S-O@0.3", "torch", "a", "centre_1m")]
    shuffled[:] = shuffled[[1, 0, 3, 2, 5, 4, 7, 6]]
    points = practicality_curves(tiles)["S-O"].points
    assert 0.05 < points[2].share_best < points[1].share_best < 0.95
    assert points[3].share_best == 0


def test_families():
    names = (
        "T-U-0",
        "S-O@0.4-1",
        "R-S-O@0.4-0",
        "C-Fc-seq@0.2",
        "C-Fc-par@0.2",
        "S-O@0.4_on_a-0",
        "R-C-Fc@0.2",
    )
    assert list(practicality_curves(made({(name, "a"): 0.5 for name in names}))) == [
        "S-O",
        "C-Fc-seq",
        "C-Fc-par",
    ]


def test_magnitudes_of_different_detectors_are_refused():
    tiles = made({("S-O@0.4", "a"): 0.5, ("S-O@0.5", "b"): 0.5})
    with pytest.raises(ConfigurationError, match="different detectors"):
        practicality_curves(tiles)
