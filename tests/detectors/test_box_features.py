"""What a detector's pyramid holds at a box: the mean over the box, at the level of its size."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from detector_images import NAMES, YOLO
from test_imported import ONE_OF_EACH, PLAN, yolo_plan
from torch import Tensor
from torchvision.ops.poolers import LevelMapper

from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.loaded import build_detector
from skyproof.detectors.region_align import area_levels
from skyproof.reproduction.gather_features import anchor_levels, box_features, pool_boxes

# One box of 36x16 px in the first image, none in the second, two in the third.
BOXES = [
    torch.tensor([[8.0, 16.0, 44.0, 32.0]]),
    torch.zeros(0, 4),
    torch.tensor([[40.0, 40.0, 76.0, 56.0], [8.0, 16.0, 44.0, 32.0]]),
]


def ramp(stride_px: int) -> Tensor:
    """Features whose first channel is the column, whose second the row, both in image pixels."""
    centres = (torch.arange(96 // stride_px) + 0.5) * stride_px
    one = torch.stack(
        [centres[None].expand(len(centres), -1), centres[:, None].expand(-1, len(centres))]
    )
    return one.expand(3, -1, -1, -1).clone()


@pytest.mark.parametrize("level", [0, 1])
def test_the_mean_of_a_ramp_is_its_value_in_the_middle_of_the_box(level: int) -> None:
    def level_of(boxes: Tensor) -> Tensor:
        return torch.full((len(boxes),), level)

    pyramid = [ramp(8), ramp(16)]
    pyramid[1 - level] *= 0
    first, none, last = pool_boxes(pyramid, 96, BOXES, level_of)
    assert none.shape == (0, 2)
    assert torch.allclose(first, torch.tensor([[26.0, 24.0]]), atol=1e-4)
    assert torch.allclose(last, torch.tensor([[58.0, 48.0], [26.0, 24.0]]), atol=1e-4)


def test_levels_by_area_are_those_of_torchvisions_regions() -> None:
    sides = torch.tensor([4.0, 24.0, 55.0, 56.0, 111.0, 112.0, 223.0, 224.0, 447.0, 448.0, 2000.0])
    boxes = torch.stack([sides * 0, sides * 0, sides * 2, sides / 2], dim=1)
    theirs = LevelMapper(2, 5)([boxes])
    assert area_levels(boxes, [4.0, 8.0, 16.0, 32.0]).tolist() == theirs.tolist()
    assert theirs.tolist() == [0, 0, 0, 0, 0, 1, 1, 2, 2, 3, 3]


def test_levels_by_anchor_are_those_of_the_most_alike() -> None:
    anchors = [
        torch.tensor([[-15.0, -7, 15, 7], [-7, -15, 7, 15]]),
        torch.tensor([[-20.0] * 2 + [20.0] * 2]),
    ]
    boxes = torch.tensor([[0.0, 0, 30, 14], [50, 50, 64, 80], [5, 5, 45, 45], [5, 5, 41, 39]])
    assert anchor_levels(anchors)(boxes).tolist() == [0, 0, 1, 1]


@torch.no_grad()
def check_features(detector: TrainableDetector) -> None:
    """Boxes are looked at where they are: what changes elsewhere hardly matters."""
    images = torch.rand(3, 3, 96, 128, generator=torch.Generator().manual_seed(3))
    before = box_features(detector, images, BOXES)
    assert [len(own) for own in before] == [1, 0, 2]
    channels = before[0].shape[1]
    assert channels >= 16
    assert all(own.shape[1] == channels and torch.isfinite(own).all() for own in before)
    # The same box in two images has two answers.
    assert not torch.allclose(before[0][0], before[2][1])
    # Only the third image is changed, at its first box alone.
    images[2, :, 40:56, 40:76] = 1.0
    after = box_features(detector, images, BOXES)
    assert torch.allclose(before[0], after[0], atol=1e-4)
    changed = (after[2] - before[2]).norm(dim=1)
    assert changed[0] > 1.5 * changed[1]


@pytest.mark.parametrize("name", NAMES)
def test_ours(name: str) -> None:
    check_features(build_detector(name, "slim", generator=torch.Generator().manual_seed(0)).eval())


@pytest.mark.parametrize("architecture", [*ONE_OF_EACH, YOLO])
def test_imported_at_another_resolution(architecture: str) -> None:
    torch.manual_seed(0)
    plan = (
        yolo_plan("yolov8n.yaml", [1])
        if architecture == "yolov5"
        else replace(PLAN, architecture=architecture)
    )
    check_features(ImportedDetector("mine", replace(plan, image_scale=2.0)).eval())
