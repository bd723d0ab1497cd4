"""The tool that counts false alarms by the spot on the ground, on frames cut from one picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

cv2 = pytest.importorskip("cv2", reason="registering frames takes the extra imagery")

from false_alarms import by_spot, false_alarms, registered, without_hidden  # noqa: E402

from skyproof.datasets.dataset import Dataset  # noqa: E402
from skyproof.detectors.detector import Detections  # noqa: E402

GSD_M = 0.125
CAR = (60.0, 60.0, 96.0, 76.0)
SEEN_OF_ANOTHER = (110.0, 20.0, 128.0, 36.0)
ALL_OF_IT = (110.0, 20.0, 146.0, 36.0)
NOTHING = (80.0, 120.0, 116.0, 136.0)


def ground(seed: int) -> Tensor:
    """A picture with blobs of all sizes, in which points are found again."""
    generator = np.random.default_rng(seed)
    picture = np.zeros((320, 320, 3), dtype=np.float32)
    for size in (4, 16, 64):
        coarse = generator.uniform(size=(size, size, 3)).astype(np.float32)
        picture += cv2.resize(coarse, (320, 320), interpolation=cv2.INTER_CUBIC)
    spread = 255 * (picture - picture.min()) / (picture.max() - picture.min())
    return torch.from_numpy(spread.astype(np.uint8)).permute(2, 0, 1)


def frames(grounds: Sequence[Tensor], shifts: Sequence[int]) -> Dataset:
    """Windows of 200 px that are shifted to the right, with a car and the visible part of one."""
    images, boxes = [], []
    for picture, shift in zip(grounds, shifts, strict=True):
        images.append(picture[:, 50:250, shift : shift + 200].contiguous())
        boxes.append(moved([CAR, SEEN_OF_ANOTHER], shift))
    return Dataset.of_images(images, boxes, gsd_m=GSD_M)


def moved(boxes: Sequence[tuple[float, float, float, float]], shift: int) -> Tensor:
    return torch.tensor(boxes) - torch.tensor([shift, 0.0, shift, 0.0])


def found(shifts: Sequence[int]) -> list[Detections]:
    """The car, all of the half-hidden one, a false alarm, and one below the threshold."""
    boxes = [CAR, ALL_OF_IT, NOTHING, (150.0, 150.0, 180.0, 166.0)]
    return [Detections(moved(boxes, shift), torch.tensor([0.9, 0.8, 0.7, 0.1])) for shift in shifts]


@pytest.mark.parametrize("shifts", [(0, 0, 0), (0, 22, 44)])
def test_a_false_alarm_on_one_spot_of_all_frames_is_one(shifts):
    picture = ground(0)
    images = frames([picture] * 3, shifts)
    grounds = registered(images)
    assert [place for place, _ in grounds] == [0, 0, 0]
    alarms = false_alarms(found(shifts), images, 0.5, grounds)
    assert by_spot(alarms, GSD_M) == [3, 3]


def test_frames_of_another_place_have_spots_of_their_own():
    images = frames([ground(0), ground(1)], (0, 0))
    grounds = registered(images)
    assert [place for place, _ in grounds] == [0, 1]
    assert by_spot(false_alarms(found((0, 0)), images, 0.5, grounds), GSD_M) == [1, 1, 1, 1]


def test_a_label_of_what_is_seen_and_the_detection_of_all_of_it_are_left_out_together():
    images = frames([ground(0)], (0,))
    alarms = false_alarms(found((0,)), images, 0.5, registered(images))
    assert alarms.hidden == [[1]]
    rest = without_hidden(images, alarms)
    assert rest.boxes[0].tolist() == [list(CAR)]
    again = false_alarms(found((0,)), rest, 0.5, registered(images))
    assert by_spot(again, GSD_M) == [1]
    assert again.hidden == [[]]
