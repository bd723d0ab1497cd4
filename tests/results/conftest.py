"""Scenes and detections small enough to check by hand."""

import math

import numpy as np
import pytest
import torch

from skyproof.detectors.detector import Detections
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def make_scene():
    def make(scene_id, tile, vehicles=1, heading_rad=0.0):
        return Scene(
            id=scene_id,
            background=BackgroundWindow(tile, 192.0, 192.0, 0.0),
            camera=Camera(math.radians(10), math.radians(-90), 0.125, 384),
            sun=Sun(math.radians(90), math.radians(30)),
            placements=tuple(
                Placement(f"pick-up-{i:04d}", 0.0, 0.0, heading_rad) for i in range(vehicles)
            ),
            seed=1,
        )

    return make


@pytest.fixture
def make_detections():
    def make(*rows):
        """Rows (centre x, centre y, score): boxes of 20 x 20 px."""
        if not rows:
            return Detections(torch.zeros(0, 4), torch.zeros(0))
        table = torch.tensor(rows)
        centre = table[:, :2]
        return Detections(torch.cat([centre - 10, centre + 10], dim=1), table[:, 2].clone())

    return make
