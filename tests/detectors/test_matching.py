"""The matcher against cases by hand and an independent brute force."""

from __future__ import annotations

import pytest
import torch

from skyproof.detectors.matching import match_detections
from skyproof.errors import ConfigurationError
from skyproof.results.outcomes import MATCHES


def at(*centres: tuple[float, float], half: float = 5.0) -> torch.Tensor:
    points = torch.tensor(centres, dtype=torch.float32).reshape(-1, 2)
    return torch.cat([points - half, points + half], dim=1)


def test_limit_is_one_metre_and_counts_as_a_match() -> None:
    truth = at((50, 50))
    for offset, expected in ((8.0, 0), (8.1, -1)):
        matches = match_detections(
            at((50 + offset, 50)), torch.tensor([0.9]), truth, criterion="centre_1m", gsd_m=0.125
        )
        assert matches.truth_of_detection.tolist() == [expected]


def test_higher_score_chooses_first_and_the_other_takes_what_is_free() -> None:
    truth = at((50, 50), (56, 50))
    boxes = at((52, 50), (51, 50), (90, 90))
    matches = match_detections(
        boxes, torch.tensor([0.5, 0.9, 0.8]), truth, criterion="centre_1m", gsd_m=0.125
    )
    assert matches.truth_of_detection.tolist() == [1, 0, -1]
    assert matches.detection_of_truth.tolist() == [1, 0]


def test_a_second_detection_of_one_vehicle_is_a_false_alarm() -> None:
    matches = match_detections(
        at((50, 50), (50, 51)),
        torch.tensor([0.6, 0.7]),
        at((50, 50)),
        criterion="iou_50",
        gsd_m=0.125,
    )
    assert matches.truth_of_detection.tolist() == [-1, 0]


def test_iou_of_exactly_one_half_matches() -> None:
    truth = torch.tensor([[0.0, 0, 10, 10]])
    boxes = torch.tensor([[0.0, 0, 10, 5], [0.0, 0, 10, 4.9]])
    matches = match_detections(
        boxes[:1], torch.tensor([0.5]), truth, criterion="iou_50", gsd_m=0.125
    )
    assert matches.truth_of_detection.tolist() == [0]
    matches = match_detections(
        boxes[1:], torch.tensor([0.5]), truth, criterion="iou_50", gsd_m=0.125
    )
    assert matches.truth_of_detection.tolist() == [-1]


def test_half_a_vehicle_finds_it_by_the_lenient_rule_alone() -> None:
    vehicle = torch.tensor([[40.0, 40, 76, 54]])
    half, beyond = torch.tensor([[58.0, 40, 76, 54]]), torch.tensor([[70.0, 40, 90, 54]])
    for boxes, rule, expected in (
        (half, "centre_1m", -1),
        (half, "centre_in_box", 0),
        (beyond, "centre_in_box", -1),
    ):
        matches = match_detections(boxes, torch.tensor([0.9]), vehicle, criterion=rule, gsd_m=0.125)
        assert matches.truth_of_detection.tolist() == [expected]
    # A centre within 1 m counts by it even where little of the vehicle is in sight.
    matches = match_detections(
        at((54, 50)), torch.ones(1), at((50, 50), half=2), criterion="centre_in_box", gsd_m=0.125
    )
    assert matches.truth_of_detection.tolist() == [0]


def test_ignore_regions_take_only_what_is_unmatched() -> None:
    ignore = torch.tensor([[0.0, 0, 60, 60]])
    matches = match_detections(
        at((50, 50), (20, 20), (60, 60)),
        torch.tensor([0.9, 0.8, 0.7]),
        at((50, 50)),
        criterion="centre_1m",
        gsd_m=0.125,
        ignore=ignore,
    )
    assert matches.ignored.tolist() == [False, True, False]
    assert matches.truth_of_detection.tolist() == [0, -1, -1]


def test_nothing_detected_and_nothing_true() -> None:
    empty = torch.zeros(0, 4)
    matches = match_detections(
        empty, torch.zeros(0), at((50, 50)), criterion="centre_1m", gsd_m=0.125
    )
    assert matches.detection_of_truth.tolist() == [-1]
    matches = match_detections(
        at((5, 5)), torch.ones(1), empty, criterion="iou_50", gsd_m=0.125, ignore=empty
    )
    assert matches.truth_of_detection.tolist() == [-1]


def brute_force(boxes: list, scores: list, truth: list, criterion: str, gsd_m: float) -> list[int]:
    """Written apart from the library: plain Python, no tensors."""
    result, free = [-1] * len(boxes), set(range(len(truth)))
    for index in sorted(range(len(boxes)), key=lambda i: (-scores[i], i)):
        best, best_quality = -1, None
        for other in sorted(free):
            a, b = boxes[index], truth[other]
            if criterion != "iou_50":
                x, y = (a[0] + a[2]) / 2, (a[1] + a[3]) / 2
                dx, dy = x - (b[0] + b[2]) / 2, y - (b[1] + b[3]) / 2
                quality, enough = (
                    -((dx * dx + dy * dy) ** 0.5),
                    (dx * dx + dy * dy) ** 0.5 * gsd_m <= 1.0,
                )
                if criterion == "centre_in_box":
                    enough = enough or (b[0] <= x < b[2] and b[1] <= y < b[3])
            else:
                w = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
                h = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
                union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - w * h
                quality, enough = w * h / union, w * h / union >= 0.5
            if enough and (best_quality is None or quality > best_quality):
                best, best_quality = other, quality
        if best >= 0:
            result[index] = best
            free.remove(best)
    return result


@pytest.mark.parametrize("criterion", MATCHES)
def test_against_brute_force(criterion: str) -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        count, vehicles = (int(torch.randint(0, top, (1,), generator=generator)) for top in (12, 8))
        truth = at(*(60 * torch.rand(vehicles, 2, generator=generator)).tolist(), half=9)
        boxes = at(*(60 * torch.rand(count, 2, generator=generator)).tolist(), half=8)
        scores = torch.randint(0, 5, (count,), generator=generator) / 5
        matches = match_detections(boxes, scores, truth, criterion=criterion, gsd_m=0.125)
        expected = brute_force(boxes.tolist(), scores.tolist(), truth.tolist(), criterion, 0.125)
        assert matches.truth_of_detection.tolist() == expected


def test_unknown_criterion_is_refused() -> None:
    with pytest.raises(Exception, match=r"(?s)criterion|centre_1m") as caught:
        match_detections(at(), torch.zeros(0), at(), criterion="iou_75", gsd_m=0.125)  # type: ignore[arg-type]
    # With run-time type checks on, beartype refuses first.
    assert isinstance(caught.value, ConfigurationError) or "iou_75" in str(caught.value)
