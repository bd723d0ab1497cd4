"""Training from nothing on rendered images, on any processor."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from detector_images import YOLO_ANCHORS
from tests.rendered_world import RenderedWorld, make_world

from skyproof.detectors.build import build_detector
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import train, validate

TRAINING_IMAGES, VALIDATION_IMAGES, TEST_IMAGES = 160, 24, 40
# Focal loss starts slowly.
STEPS = {"retinanet": 200, "faster_rcnn": 140, "yolov5_anchors": 200}
NAMES = ["retinanet", "faster_rcnn", YOLO_ANCHORS]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> RenderedWorld:
    return make_world(tmp_path_factory.mktemp("world"))


@pytest.mark.parametrize("name", NAMES)
def test_a_detector_learns_to_find_vehicles_that_it_never_saw(
    name: str, world: RenderedWorld, tmp_path: Path
) -> None:
    training, validation, test = (
        world.images(split, world.scenes(split, count, least, most))
        for split, count, least, most in (
            ("train", TRAINING_IMAGES, 0, 4),
            ("validation", VALIDATION_IMAGES, 1, 4),
            ("test", TEST_IMAGES, 1, 2),
        )
    )
    generator = torch.Generator().manual_seed(0)
    detector = build_detector(name, "slim", generator=generator)
    before = validate(detector.eval(), test)["ap_centre_1m"]
    steps = STEPS[name]
    settings = TrainingSettings(
        steps=steps, batch_size=4, validate_every=steps, checkpoint_every=steps
    )
    train(detector.train(), training, validation, settings, tmp_path, generator=generator)
    after = validate(detector.eval(), test)["ap_centre_1m"]
    assert after > before + 0.35, (before, after)
