"""Another threshold, from labels."""

import pytest
import torch
from tests.measure.world import judging

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.detectors.validation import frozen_card
from skyproof.errors import ConfigurationError

SIDE_PX = 800


class Scripted:
    """Gives every image the same detections, a row of boxes 40 px apart."""

    name = "scripted"

    def __init__(self, *scores):
        self.scores = torch.tensor(scores)

    def detect(self, images):
        left = 40.0 * torch.arange(len(self.scores))
        boxes = torch.stack((left, left * 0, left + 20, left * 0 + 20), 1)
        return [Detections(boxes, self.scores) for _ in images]


def images(count, vehicles=0):
    left = 40.0 * torch.arange(vehicles)
    boxes = torch.stack((left, left * 0, left + 20, left * 0 + 20), 1)
    image = torch.zeros(3, SIDE_PX, SIDE_PX, dtype=torch.uint8)
    return Dataset.of_images([image] * count, [boxes] * count, gsd_m=0.125)


def test_labels_give_the_threshold_of_the_largest_f1():
    judge = judging(Scripted(0.9, 0.8, 0.3, 0.2), threshold=0.85)
    frames = [images(1, vehicles=2)]
    assert frozen_card(judge, Dataset.joined(frames), "").threshold == pytest.approx(0.55)
    # Further frames count as well: where all four are vehicles, the lowest scores count.
    frames.append(images(9, vehicles=4))
    assert frozen_card(judge, Dataset.joined(frames), "").threshold == pytest.approx(0.105)


def test_labels_on_which_nothing_is_found_are_refused():
    judge = judging(Scripted())
    with pytest.raises(ConfigurationError, match="finds none of the 2 labelled vehicles"):
        frozen_card(judge, images(1, vehicles=2), "")
