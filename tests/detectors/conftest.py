"""Detectors trained for a few seconds, shared by tests that need one that sees something."""

from __future__ import annotations

import pytest
import torch
from detector_images import NAMES, bar_images

from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import build_detector


@pytest.fixture(scope="session", params=NAMES)
def trained(request: pytest.FixtureRequest) -> TrainableDetector:
    """A slim detector after some steps on a handful of images: in eval mode, weights frozen."""
    detector = build_detector(
        request.param, "slim", generator=torch.Generator().manual_seed(0)
    ).train()
    for module in detector.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            # So few steps are too few for the running statistics of eval mode to arrive
            # (Ultralytics: 0.03).
            module.momentum = 0.3
    labelled = bar_images(6, seed=1)
    images = torch.stack(labelled.images(range(len(labelled)))).float() / 255
    optimiser = torch.optim.AdamW(detector.parameters(), lr=2e-3)
    for _ in range(40):
        optimiser.zero_grad()
        detector.loss(images, list(labelled.boxes)).mean().backward()
        optimiser.step()
    return detector.eval().requires_grad_(False)
