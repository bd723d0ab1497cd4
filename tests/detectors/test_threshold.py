"""Another threshold, from labels or from a wanted number of false alarms."""

import json
import shutil

import pytest
import torch
from tests.measure.world import judging, make_backgrounds

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.detectors.threshold import empty_tiles, threshold_of_alarms, threshold_of_labels
from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet

SIDE_PX = 800
AREA_KM2 = (SIDE_PX * 0.125) ** 2 / 1e6  # 0.01


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
    assert threshold_of_labels(judge, frames) == pytest.approx(0.55)
    # Further frames count as well: where all four are vehicles, the lowest scores count.
    frames.append(images(9, vehicles=4))
    assert threshold_of_labels(judge, frames) == pytest.approx(0.105)


def test_labels_on_which_nothing_is_found_are_refused():
    judge = judging(Scripted())
    with pytest.raises(ConfigurationError, match="finds none of the 2 labelled vehicles"):
        threshold_of_labels(judge, [images(1, vehicles=2)])


@pytest.mark.parametrize(
    ("wanted", "threshold"), [(100.0, 0.6), (200.0, 0.4), (299.0, 0.4), (300.0, 0.2)]
)
def test_alarms_give_the_lowest_threshold_with_few_enough(wanted, threshold):
    judge = judging(Scripted(0.7, 0.5, 0.3, 0.1))
    found = threshold_of_alarms(judge, images(1), wanted)
    assert found == pytest.approx(threshold)
    kept = sum(score >= found for score in (0.7, 0.5, 0.3, 0.1))
    assert kept / AREA_KM2 <= wanted < (kept + 1) / AREA_KM2


def test_alarms_that_cannot_be_counted_are_refused():
    judge = judging(Scripted(0.7, 0.5))
    with pytest.raises(ConfigurationError, match=r"On 0\.01 km² .* give at least 0\.1 km²"):
        threshold_of_alarms(judge, images(1), 10.0)
    assert threshold_of_alarms(judge, images(1), 300.0) == 0.01  # allowed more than there are
    with pytest.raises(ConfigurationError, match="largest score to more than 1 places"):
        threshold_of_alarms(judging(Scripted(1.0, 1.0)), images(1), 100.0)


@pytest.fixture
def backgrounds(tmp_path):
    return make_backgrounds(tmp_path / "drawn")


def test_empty_ground_is_that_of_the_validation_split(backgrounds):
    tiles = empty_tiles(backgrounds)
    assert list(tiles.ids) == ["tile-4"]
    assert not len(tiles.boxes[0])
    assert torch.equal(tiles.image(0), backgrounds.pixels("tile-4"))


def test_ground_with_labelled_vehicles_is_not_empty(backgrounds, tmp_path):
    ground = shutil.copytree(backgrounds.folder, tmp_path / "ground")
    rows = [
        {"image_id": 1, "bbox": [0, 0, 9, 9], "iscrowd": iscrowd, "id": iscrowd}
        for iscrowd in (0, 1)
    ]
    image = {"id": 1, "width": 96, "height": 96, "file_name": "a.png", "scene_id": "tile-4"}
    document = {"info": {"gsd_m": 0.125}, "images": [image], "annotations": rows}
    (ground / "validation").mkdir()
    path = ground / "validation" / "annotations.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigurationError, match="have 1 labelled vehicles"):
        empty_tiles(BackgroundSet.open(ground))
    path.write_text(json.dumps({**document, "annotations": rows[1:]}))
    assert len(empty_tiles(BackgroundSet.open(ground)))
