"""Training from nothing on rendered images, on any processor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tests.rendered_world import make_world

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import build_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import train
from skyproof.detectors.validation import validate

pytestmark = pytest.mark.slow

TRAINING_IMAGES, VALIDATION_IMAGES, TEST_IMAGES = 160, 24, 40
# Focal loss starts slowly.
STEPS = {"retinanet": 200, "faster_rcnn": 140}
BATCH_SIZE = 4


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    """What detectors learn from, choose their threshold by, and are measured on."""
    world = make_world(tmp_path_factory.mktemp("world"))
    return [
        world.images(split, world.scenes(split, count, least, most))
        for split, count, least, most in (
            ("train", TRAINING_IMAGES, 0, 4),
            ("validation", VALIDATION_IMAGES, 1, 4),
            ("test", TEST_IMAGES, 1, 2),
        )
    ]


def learnt(
    name: str,
    images: list[Dataset],
    folder: Path,
    measure: Callable[[TrainableDetector, Dataset], float],
) -> tuple[float, float]:
    """Measures a detector on images that it never sees, before and after its training."""
    training, validation, test = images
    generator = torch.Generator().manual_seed(0)
    detector = build_detector(name, "slim", generator=generator)
    before = measure(detector.eval(), test)
    steps = STEPS[name]
    settings = TrainingSettings(
        steps=steps, batch_size=BATCH_SIZE, validate_every=steps, checkpoint_every=steps
    )
    train(detector.train(), training, validation, settings, folder, generator=generator)
    return before, measure(detector.eval(), test)


def ap(detector: TrainableDetector, images: Dataset) -> float:
    return validate(detector, images)["ap_centre_1m"]


@pytest.mark.parametrize("name", ["retinanet", "faster_rcnn"])
def test_a_detector_learns_to_find_vehicles_that_it_never_saw(
    name: str, images: list[Dataset], tmp_path: Path
) -> None:
    before, after = learnt(name, images, tmp_path, ap)
    assert after > before + 0.35, (before, after)
