"""Filling masks: ground from nearby against known ground."""

import numpy as np
import torch

from skyproof.imagery.clearing import exemplar
from skyproof.imagery.clearing.exemplar import fill_by_exemplar, fill_ground


def hole(height=140, width=180, place=(slice(50, 80), slice(60, 100))):
    mask = np.zeros((height, width), dtype=bool)
    mask[place] = True
    return mask


def test_a_pattern_that_repeats_is_filled_exactly():
    rows, columns = np.mgrid[0:140, 0:180]
    truth = np.stack([0.3 + 0.4 * ((rows + 2 * columns) % 24 < 4)] * 3, 2)
    mask = hole()
    damaged = truth.copy()
    damaged[mask] = 1.0
    filled = fill_by_exemplar(damaged, mask)
    assert abs(filled - truth).max() < 1e-3
    assert np.array_equal(filled[~mask], truth[~mask])


def test_noise_stays_noise():
    rng = np.random.default_rng(0)
    truth = 0.5 + 0.05 * rng.standard_normal((140, 180, 3))
    mask = hole()
    damaged = np.where(mask[..., None], 0.0, truth)
    filled = fill_by_exemplar(damaged, mask)
    assert 0.9 < filled[mask].std() / 0.05 < 1.1


def test_a_slope_of_brightness_goes_on_without_a_step():
    truth = np.stack([np.tile(np.linspace(0.2, 0.8, 180), (140, 1))] * 3, 2)
    mask = hole()
    filled = fill_by_exemplar(np.where(mask[..., None], 1.0, truth), mask)
    assert abs(filled - truth).max() < 0.03


def test_nothing_is_copied_from_other_vehicles():
    rng = np.random.default_rng(1)
    truth = 0.5 + 0.02 * rng.standard_normal((140, 180, 3))
    mask = (
        hole()
        | hole(place=(slice(90, 120), slice(20, 60)))
        | hole(place=(slice(10, 40), slice(110, 150)))
    )
    damaged = truth.copy()
    damaged[mask] = (1.0, 0.0, 1.0)
    filled = fill_by_exemplar(damaged, mask)
    assert abs(filled[mask] - 0.5).max() < 0.15


def test_colours_of_the_edge_go_on_where_no_place_fits():
    # A slope is its own solution of Laplace's equation.
    truth = np.stack([np.tile(np.linspace(0.2, 0.8, 40), (40, 1))] * 3, 2)
    mask = np.zeros((40, 40), dtype=bool)
    mask[3:-3, 3:-3] = True
    filled = fill_by_exemplar(np.where(mask[..., None], 1.0, truth), mask)
    assert abs(filled - truth).max() < 1e-3
    assert (filled[~mask] == truth[~mask]).all()


def test_large_holes_are_filled_piece_by_piece():
    rng = np.random.default_rng(2)
    truth = 0.5 + 0.03 * rng.standard_normal((220, 320, 3))
    mask = hole(220, 320, (slice(90, 120), slice(60, 260)))
    filled = fill_by_exemplar(np.where(mask[..., None], 0.0, truth), mask)
    assert abs(filled[mask].mean() - 0.5) < 0.01
    assert filled[mask].std() > 0.8 * 0.03


def test_bytes_outside_the_mask_stay():
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (3, 50, 61), dtype=torch.uint8, generator=generator)
    mask = torch.zeros(50, 61, dtype=torch.bool)
    mask[10:20, 30:45] = True
    filled = fill_ground(image, mask)
    assert torch.equal(filled[:, ~mask], image[:, ~mask])
    assert not torch.equal(filled, image)


def test_far_from_the_hole_nothing_is_weighed_and_no_value_changes(monkeypatch):
    rng = np.random.default_rng(2)
    truth = rng.random((300, 320, 3))
    mask = hole(300, 320, (slice(120, 150), slice(140, 170)))
    filled = fill_by_exemplar(truth, mask)
    sizes = []
    blur = exemplar.ndimage.gaussian_filter

    def noted(values, *options, **more):
        sizes.append(values.shape)
        return blur(values, *options, **more)

    monkeypatch.setattr(exemplar.ndimage, "gaussian_filter", noted)
    assert np.array_equal(fill_by_exemplar(truth, mask), filled)
    assert sizes
    assert max(max(size) for size in sizes) < 150
    # The same with weights all over the window.
    around, search_px = exemplar._around, exemplar._SEARCH_PX
    monkeypatch.setattr(
        exemplar, "_around", lambda flags, px: around(flags, px if px > search_px else 1000)
    )
    assert np.array_equal(fill_by_exemplar(truth, mask), filled)
