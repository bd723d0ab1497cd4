"""Filling masks: ground from nearby against known ground."""

import numpy as np
import torch

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


def share_of_wrong_pixels(truth, mask):
    truth = truth + 0.01 * np.random.default_rng(3).standard_normal(truth.shape)
    filled = fill_by_exemplar(np.where(mask[..., None], 1.0, truth), mask)
    return (abs(filled - truth).max(2) > 0.15)[mask].mean()


def test_lines_and_kerbs_go_on_whole_through_a_large_hole():
    # Pieces of 24 px alone would lose seven pixels in a thousand, which are a tenth of the lines.
    rows, columns = np.mgrid[0:200, 0:220]
    truth = np.full((200, 220, 3), 0.3)
    truth[(rows % 34 < 2) & (columns % 70 < 40)] = 0.85
    truth[columns > 140] = (0.25, 0.4, 0.2)
    assert share_of_wrong_pixels(truth, hole(200, 220, (slice(70, 130), slice(90, 185)))) < 0.002


def test_a_hole_that_no_single_place_fits_is_filled_in_smaller_pieces():
    # The crossing of four grounds is nowhere else; whole, a fifth of the hole would be wrong.
    rows, columns = np.mgrid[0:200, 0:220]
    truth = np.full((200, 220, 3), 0.3)
    truth[rows > 100] = (0.6, 0.55, 0.45)
    truth[columns > 120] = (0.25, 0.4, 0.2)
    truth[(rows > 100) & (columns > 120)] = (0.7, 0.2, 0.1)
    assert share_of_wrong_pixels(truth, hole(200, 220, (slice(70, 130), slice(90, 150)))) < 0.05
