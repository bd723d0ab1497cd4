"""Which detection found which vehicle: one matcher for average precision and for success rates (PAPER 19)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torchvision import ops

from skyproof.errors import ConfigurationError

__all__ = ["CENTRE_DISTANCE_M", "MATCH_IOU", "Criterion", "Matches", "match_detections"]

Criterion = Literal["centre_1m", "iou_50"]
CENTRE_DISTANCE_M = 1.0
MATCH_IOU = 0.5
# Detections at a time: more than a detector returns of an image that it sees whole.
_PART = 512


@dataclass(frozen=True)
class Matches:
    """The pairing of one image's detections with its vehicles.

    Attributes:
        truth_of_detection: `[K]` index of the matched vehicle, or -1.
        ignored: `[K]` True where an unmatched detection lies in an ignore region: neither hit nor false alarm.
        detection_of_truth: `[T]` index of the matched detection, or -1 for a missed vehicle.
        score_of_truth: `[T]` score of that detection, 0 for a missed vehicle.
    """

    truth_of_detection: Int64[Tensor, " K"]
    ignored: Bool[Tensor, " K"]
    detection_of_truth: Int64[Tensor, " T"]
    score_of_truth: Float[Tensor, " T"]


@torch.no_grad()
def match_detections(
    boxes: Float[Tensor, "K 4"],
    scores: Float[Tensor, " K"],
    truth: Float[Tensor, "T 4"],
    *,
    criterion: Criterion,
    gsd_m: float,
    ignore: Float[Tensor, "m 4"] | None = None,
) -> Matches:
    """Pairs detections with vehicles one-to-one, greedily by falling score (PAPER 19).

    Each detection in turn takes the best vehicle still free: the nearest centre within 1.0 m, or the largest IoU of at
    least 0.5. Equal scores keep their order.

    Args:
        boxes: detections, pixel xyxy.
        scores: in any order.
        truth: vehicles, pixel xyxy.
        criterion: "centre_1m" or "iou_50".
        gsd_m: metres per pixel.
        ignore: regions, pixel xyxy, in which an unmatched detection's centre counts for nothing (PAPER 1).

    Raises:
        ConfigurationError: another criterion, or a resolution that is not positive.
    """
    if criterion not in get_args(Criterion) or not gsd_m > 0:
        raise ConfigurationError(
            f'Matching expects "centre_1m" or "iou_50" and gsd_m above 0, but got "{criterion}" and {gsd_m}.'
        )
    centres = _centres(boxes)
    # Which pairs are near enough. Large images have thousands of detections and vehicles, so the
    # table of all pairs is made in parts.
    pairs: dict[int, list[tuple[float, int]]] = {}
    for start in range(0, len(boxes) if len(truth) else 0, _PART):
        part = slice(start, start + _PART)
        if criterion == "centre_1m":
            cost = torch.cdist(centres[part].double(), _centres(truth).double()) * gsd_m
            limit = CENTRE_DISTANCE_M
        else:
            cost = -ops.box_iou(boxes[part].double(), truth.double())
            limit = -MATCH_IOU
        # A difference of rounding must not decide at the limit.
        near = torch.nonzero(cost <= limit + 1e-9)
        costs = cost[near[:, 0], near[:, 1]].tolist()
        for (detection, vehicle), value in zip(near.tolist(), costs, strict=True):
            pairs.setdefault(start + detection, []).append((value, vehicle))
    # Detections choose in turn, on the CPU.
    truth_of_detection = torch.full((len(boxes),), -1, dtype=torch.int64)
    detection_of_truth = torch.full((len(truth),), -1, dtype=torch.int64)
    for detection in torch.argsort(scores.cpu(), descending=True, stable=True).tolist():
        free = [pair for pair in pairs.get(detection, ()) if detection_of_truth[pair[1]] < 0]
        if free:
            best = min(free)[1]
            truth_of_detection[detection] = best
            detection_of_truth[best] = detection
    # Which of the others lie where nothing is scored.
    ignored = torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    if ignore is not None and len(ignore):
        inside = (centres[:, None] >= ignore[None, :, :2]) & (
            centres[:, None] < ignore[None, :, 2:]
        )
        ignored = inside.all(dim=2).any(dim=1) & (truth_of_detection.to(boxes.device) < 0)
    truth_of_detection = truth_of_detection.to(boxes.device)
    detection_of_truth = detection_of_truth.to(boxes.device)
    found = detection_of_truth >= 0
    score_of_truth = scores.new_zeros(len(truth))
    score_of_truth[found] = scores[detection_of_truth[found]]
    return Matches(truth_of_detection, ignored, detection_of_truth, score_of_truth)


def _centres(boxes: Tensor) -> Tensor:
    return (boxes[:, :2] + boxes[:, 2:]) / 2
