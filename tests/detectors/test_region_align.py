"""Regions sampled at the centres of their bins, beside torchvision's own RoIAlign."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchvision import ops

from skyproof.detectors.region_align import CentreAlign


@pytest.fixture
def pyramid() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        "0": torch.randn(3, 16, 12, 16, generator=generator).requires_grad_(),
        "1": torch.randn(3, 16, 6, 8, generator=generator).requires_grad_(),
    }


def regions(counts: list[int]) -> list[Tensor]:
    """Draws small and large ones, some across the border of 128 x 96 px or beyond it."""
    generator = torch.Generator().manual_seed(1)
    drawn = []
    for count in counts:
        centres = torch.rand(count, 2, generator=generator) * 180 - 30
        sides = torch.rand(count, 2, generator=generator) * torch.tensor([[600.0, 500.0]])
        sides[::2] /= 20
        drawn.append(torch.cat([centres - sides / 2, centres + sides / 2], dim=1))
    return drawn


@pytest.mark.parametrize("counts", [[40, 0, 25], [0, 0, 0]])
def test_values_and_gradients_are_those_of_torchvision(
    pyramid: dict[str, Tensor], counts: list[int]
) -> None:
    boxes = regions(counts)
    sizes = [(96, 128)] * 3
    weights = torch.randn(sum(counts), 16, 5, 5, generator=torch.Generator().manual_seed(2))
    found = []
    for align in (CentreAlign((8.0, 16.0), 5), ops.MultiScaleRoIAlign(["0", "1"], 5, 1)):
        pooled = align(pyramid, boxes, sizes)
        gradients = torch.autograd.grad((pooled * weights).sum(), list(pyramid.values()))
        found.append((pooled, *gradients))
    for own, theirs in zip(*found, strict=True):
        torch.testing.assert_close(own, theirs, atol=2e-5, rtol=1e-4)
    if any(counts):
        # Both levels, and places where torchvision gives nothing, are among what was compared.
        assert all(gradient.any() for gradient in found[1][1:])
        assert (found[1][0] == 0).any()


def test_regions_take_no_gradient(pyramid: dict[str, Tensor]) -> None:
    boxes = [box.requires_grad_() for box in regions([5, 5, 5])]
    CentreAlign((8.0, 16.0), 5)(pyramid, boxes, [(96, 128)] * 3).sum().backward()
    assert all(box.grad is None for box in boxes)
