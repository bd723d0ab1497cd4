"""Filling masks: ground from nearby against known ground, and OpenCV."""

import sys

import numpy as np
import pytest
import torch

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.imagery.clearing.exemplar import fill_by_exemplar
from skyproof.imagery.clearing.inpainting import (
    Diffusion,
    Exemplar,
    apply_inpainting,
    inpainting_record,
)


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


def test_noise_stays_noise_where_diffusion_is_smooth():
    rng = np.random.default_rng(0)
    truth = 0.5 + 0.05 * rng.standard_normal((140, 180, 3))
    mask = hole()
    damaged = np.where(mask[..., None], 0.0, truth)
    filled = fill_by_exemplar(damaged, mask)
    assert 0.9 < filled[mask].std() / 0.05 < 1.1
    image = torch.from_numpy(damaged).permute(2, 0, 1).float().clamp(0, 1)
    smooth = Diffusion()(image, torch.from_numpy(mask))
    assert smooth[:, torch.from_numpy(mask)].std() < 0.5 * 0.05


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


def test_what_was_there_before_stays_where_no_place_fits():
    image, mask = np.full((40, 40, 3), 0.5), np.ones((40, 40), dtype=bool)
    mask[:3] = False
    start = np.full((40, 40, 3), 0.25)
    filled = fill_by_exemplar(image, mask, start=start)
    assert (filled[mask] == 0.25).all()
    assert (filled[~mask] == 0.5).all()


def test_large_holes_are_filled_piece_by_piece():
    rng = np.random.default_rng(2)
    truth = 0.5 + 0.03 * rng.standard_normal((220, 320, 3))
    mask = hole(220, 320, (slice(90, 120), slice(60, 260)))
    filled = fill_by_exemplar(np.where(mask[..., None], 0.0, truth), mask)
    assert abs(filled[mask].mean() - 0.5) < 0.01
    assert filled[mask].std() > 0.8 * 0.03


pytest.importorskip("cv2", reason="needs the imagery extra")

IMAGE = torch.randint(
    0, 256, (3, 50, 61), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
)
MASK = torch.zeros(50, 61, dtype=torch.bool)
MASK[10:20, 30:45] = True


@pytest.mark.parametrize(
    "inpainting", [Exemplar(), Diffusion(), Diffusion("navier-stokes")], ids=str
)
def test_bytes_outside_the_mask_stay(inpainting):
    filled = apply_inpainting(inpainting, IMAGE, MASK)
    assert torch.equal(filled[:, ~MASK], IMAGE[:, ~MASK])
    assert not torch.equal(filled, IMAGE)


def test_any_function_serves_and_only_the_mask_is_taken_from_it():
    def grey(image, mask):
        mask[:] = True
        return torch.full_like(image, 0.4)

    filled = apply_inpainting(grey, IMAGE, MASK)
    assert (filled[:, MASK] == 102).all()
    assert torch.equal(filled[:, ~MASK], IMAGE[:, ~MASK])
    assert inpainting_record(grey) == {"name": "grey"}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda image, mask: image[:, :-1], r"returned torch.float32 \(3, 49, 61\)"),
        (lambda image, mask: image.numpy(), "returned ndarray"),
        (lambda image, mask: image.to(torch.uint8), "returned torch.uint8"),
        (lambda image, mask: image * torch.nan, "not finite"),
        (lambda image, mask: image @ image, "failed on a tile"),
    ],
)
def test_a_function_that_returns_something_else_is_refused(wrong, words):
    with pytest.raises(ImageryError, match=words):
        apply_inpainting(wrong, IMAGE, MASK)


def test_a_missing_opencv_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ConfigurationError, match="extra 'imagery'"):
        Diffusion()(torch.zeros(3, 20, 20), torch.ones(20, 20, dtype=torch.bool))
    with pytest.raises(ConfigurationError, match="extra 'imagery'"):
        Exemplar().record()
