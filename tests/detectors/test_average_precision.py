"""Average precision against faster-coco-eval, and the F1 threshold by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detections
from skyproof.detectors.matching import match_images
from skyproof.detectors.validation import (
    PrecisionRecall,
    average_precision,
    best_f1_threshold,
    frozen_threshold,
    precision_recall,
)
from skyproof.errors import ConfigurationError


def labelled(boxes: list[torch.Tensor], ignore: list[torch.Tensor] | None = None) -> Dataset:
    images = [torch.zeros(3, 96, 96, dtype=torch.uint8)] * len(boxes)
    return Dataset.of_images(images, boxes, gsd_m=0.125, ignore=ignore)


def random_case(seed: int) -> tuple[list[Detections], Dataset]:
    generator = torch.Generator().manual_seed(seed)
    found, truth = [], []
    for index in range(25):
        corners = 300 * torch.rand(index % 5, 2, generator=generator)
        own = torch.cat(
            [corners, corners + 15 + 25 * torch.rand(len(corners), 2, generator=generator)], dim=1
        )
        hit = own[torch.rand(len(own), generator=generator) < 0.8]
        moved = hit + 6 * torch.randn(hit.shape, generator=generator)
        strays = 300 * torch.rand(3, 2, generator=generator)
        boxes = torch.cat([moved, torch.cat([strays, strays + 30], dim=1)])
        boxes = torch.cat([torch.minimum(boxes[:, :2], boxes[:, 2:] - 1), boxes[:, 2:]], dim=1)
        scores = (
            (torch.rand(len(boxes), generator=generator) * 0.98 + 0.01).sort(descending=True).values
        )
        found.append(Detections(boxes[torch.randperm(len(boxes), generator=generator)], scores))
        truth.append(own)
    return found, labelled(truth)


def test_the_last_bit_of_a_recall_level_is_cocos() -> None:
    """Seven of ten vehicles without a false alarm: 70 of 101 levels are reached, not 71."""
    boxes = torch.tensor([[9.0 * place, 1, 9.0 * place + 8, 5] for place in range(10)])
    found = Detections(boxes[:7], torch.linspace(0.9, 0.5, 7))
    matches = match_images([found], labelled([boxes]), criterion="iou_50")
    assert average_precision(matches) == pytest.approx(70 / 101, abs=1e-12)


@pytest.mark.parametrize("seed", range(40))
def test_equals_coco_at_iou_one_half(seed: int) -> None:
    coco_eval = pytest.importorskip("faster_coco_eval", reason="faster-coco-eval is not installed")
    found, truth = random_case(seed)
    annotations, results = [], []
    for image, boxes in enumerate(truth.boxes):
        for x1, y1, x2, y2 in boxes.tolist():
            box = [x1, y1, x2 - x1, y2 - y1]
            area = box[2] * box[3]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": image,
                    "category_id": 1,
                    "bbox": box,
                    "area": area,
                    "iscrowd": 0,
                }
            )
        own = found[image]
        for (x1, y1, x2, y2), score in zip(own.boxes.tolist(), own.scores.tolist(), strict=True):
            results.append(
                {
                    "image_id": image,
                    "category_id": 1,
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "score": score,
                }
            )
    dataset = {
        "images": [{"id": image, "width": 400, "height": 400} for image in range(len(truth))],
        "categories": [{"id": 1, "name": "vehicle"}],
        "annotations": annotations,
    }
    coco = coco_eval.COCO(dataset)
    evaluation = coco_eval.COCOeval_faster(coco, coco.loadRes(results), "bbox")
    evaluation.run()
    ap = average_precision(match_images(found, truth, criterion="iou_50"))
    assert 0.01 < ap < 0.95
    assert ap == pytest.approx(float(evaluation.stats[1]), abs=1e-12)


def ap_of(found: list[Detections], truth: Dataset) -> float:
    return average_precision(match_images(found, truth, criterion="centre_1m"))


def test_perfect_and_empty_detections() -> None:
    boxes = torch.tensor([[10.0, 10, 46, 25]])
    truth = labelled([boxes, torch.zeros(0, 4)])
    nothing = Detections(torch.zeros(0, 4), torch.zeros(0))
    assert ap_of([Detections(boxes, torch.ones(1)), nothing], truth) == 1.0
    assert ap_of([nothing, nothing], truth) == 0.0
    no_vehicle = ap_of([nothing], labelled([torch.zeros(0, 4)]))
    assert no_vehicle != no_vehicle
    with pytest.raises(ConfigurationError, match="2"):
        match_images([nothing], truth, criterion="centre_1m")


def test_detections_in_ignore_regions_do_not_count() -> None:
    boxes = torch.tensor([[10.0, 10, 46, 25], [60.0, 60, 90, 80]])
    ignore = [torch.tensor([[50.0, 50, 96, 96]])]
    found = [Detections(boxes, torch.tensor([0.5, 0.4]))]
    matches = match_images(found, labelled([boxes[:1]], ignore), criterion="centre_1m")
    assert precision_recall(matches).precision.tolist() == [1.0]


def curve(scores: list[float], hits: list[int], vehicles: int) -> PrecisionRecall:
    positives = np.cumsum(np.array(hits, dtype=np.float64))
    precision = positives / np.arange(1, len(hits) + 1)
    values = np.array(scores, dtype=np.float64)
    return PrecisionRecall(values, precision, positives / vehicles, vehicles)


def test_f1_threshold_lies_midway_below_the_best_detection() -> None:
    # F1 after each: 2/5, 4/6, 4/7, 6/8, 6/9 with four vehicles.
    threshold, f1 = best_f1_threshold(curve([0.9, 0.8, 0.7, 0.6, 0.2], [1, 1, 0, 1, 0], 4))
    assert threshold == pytest.approx(0.4)
    assert f1 == pytest.approx(0.75)


def test_f1_threshold_never_splits_a_tie() -> None:
    # After the first of the tied pair F1 would be 1, but its twin of the same score is a false
    # alarm.
    threshold, f1 = best_f1_threshold(curve([0.8, 0.8, 0.3], [1, 0, 0], 1))
    assert threshold == pytest.approx(0.55)
    assert f1 == pytest.approx(2 / 3)


def test_f1_threshold_without_any_hit_or_below_the_last() -> None:
    assert best_f1_threshold(curve([0.8], [0], 1)) == (1.0, 0.0)
    assert best_f1_threshold(curve([], [], 1)) == (1.0, 0.0)
    threshold, f1 = best_f1_threshold(curve([0.8], [1], 1))
    assert threshold == pytest.approx((0.8 + 0.01) / 2)
    assert f1 == 1.0


def test_the_frozen_threshold_is_the_middle_of_those_as_good_as_the_best() -> None:
    # 200 vehicles: 199 are found by 0.9, the last by 0.4; two false alarms lie between, and some
    # below. F1 is 0.9975 at 0.9, 0.9950 at 0.4, 0.9901 after two more, and 0.9877, 0.9852 after
    # three and four: the third costs 0.98 of a point, the fourth 1.2. The first threshold within a
    # point, F1 0.9899, counts 196 vehicles.
    scores = [*np.linspace(0.99, 0.9, 199), 0.7, 0.6, 0.4, 0.3, 0.2, 0.1, 0.05]
    hits = [*[1] * 199, 0, 0, 1, 0, 0, 0, 0]
    best, _ = best_f1_threshold(curve(scores, hits, 200))
    assert best == pytest.approx(0.8)
    # The middle of 0.075 and about 0.90 lies between the scores 0.6 and 0.4.
    frozen, f1 = frozen_threshold(curve(scores, hits, 200))
    assert frozen == pytest.approx(0.5)
    assert f1 == pytest.approx(2 * 199 / (200 + 201))


def test_few_vehicles_freeze_the_peak_itself() -> None:
    few = curve([0.9, 0.8, 0.7, 0.6, 0.2], [1, 1, 0, 1, 0], 4)
    assert frozen_threshold(few) == best_f1_threshold(few)


def test_the_frozen_threshold_parts_no_tie() -> None:
    # The middle of 0.75 and 0.4 lies within the tie of 0.6, whose three detections count together.
    scores = [*np.linspace(0.99, 0.9, 100), 0.6, 0.6, 0.6, 0.2]
    frozen, f1 = frozen_threshold(curve(scores, [*[1] * 100, 1, 0, 0, 0], 101))
    assert frozen == pytest.approx(0.75)
    assert f1 == pytest.approx(200 / 201)


def test_the_frozen_threshold_of_nothing_found_is_one() -> None:
    assert frozen_threshold(curve([0.8], [0], 1)) == (1.0, 0.0)
