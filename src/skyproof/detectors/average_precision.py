"""Precision against recall over a set of images, average precision, and the threshold of the best F1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.common import LOWEST_SCORE
from skyproof.detectors.detector import Detections
from skyproof.detectors.matching import Criterion, match_detections
from skyproof.errors import ConfigurationError

__all__ = ["PrecisionRecall", "average_precision", "best_f1_threshold"]


@dataclass(frozen=True)
class PrecisionRecall:
    """Precision and recall when every detection down to each score counts.

    Attributes:
        scores: `[K]` falling; detections in ignore regions are left out.
        precision: `[K]`, 0 to 1.
        recall: `[K]`, 0 to 1.
        ap: average precision, 0 to 1; NaN when there is no vehicle at all.
        vehicle_count: true vehicles in all images.
    """

    scores: Float64[Tensor, " K"]
    precision: Float64[Tensor, " K"]
    recall: Float64[Tensor, " K"]
    ap: float
    vehicle_count: int


def average_precision(
    detections: Sequence[Detections], labelled: Dataset, *, criterion: Criterion
) -> PrecisionRecall:
    """COCO's 101-point interpolated average precision, with our matcher (PAPER 17, 19).

    With "iou_50" it equals COCO's AP at IoU 0.5 (one class, all areas, 100 detections) where there are no ignore
    regions; COCO has no centre criterion.

    Args:
        detections: per image, as `Detector.detect` returns them.
        labelled: the same images with their vehicles; only boxes, ignore regions and `gsd_m` are read.
        criterion: "centre_1m" or "iou_50".

    Raises:
        ConfigurationError: as many detections as images are expected.
    """
    if len(detections) != len(labelled):
        raise ConfigurationError(
            f"Got detections for {len(detections)} images but labels for {len(labelled)}."
        )
    scores, hits = [], []
    for found, truth, ignore in zip(detections, labelled.boxes, labelled.ignore, strict=True):
        boxes, own_scores = found.boxes.cpu(), found.scores.cpu()
        matches = match_detections(
            boxes,
            own_scores,
            truth.cpu(),
            criterion=criterion,
            gsd_m=labelled.gsd_m,
            ignore=ignore.cpu(),
        )
        counted = ~matches.ignored
        scores.append(own_scores[counted].double())
        hits.append(matches.truth_of_detection[counted] >= 0)
    vehicle_count = sum(len(truth) for truth in labelled.boxes)
    all_scores = torch.cat(scores) if scores else torch.zeros(0, dtype=torch.float64)
    all_hits = torch.cat(hits) if hits else torch.zeros(0, dtype=torch.bool)
    order = torch.argsort(all_scores, descending=True, stable=True)
    true_positives = all_hits[order].double().cumsum(0)
    precision = true_positives / torch.arange(1, len(order) + 1, dtype=torch.float64)
    recall = true_positives / max(vehicle_count, 1)
    return PrecisionRecall(
        scores=all_scores[order],
        precision=precision,
        recall=recall,
        ap=_interpolated(precision, recall) if vehicle_count else float("nan"),
        vehicle_count=vehicle_count,
    )


def best_f1_threshold(curve: PrecisionRecall) -> tuple[float, float]:
    """The score threshold of the largest F1, and that F1 (PAPER 18).

    Detections of equal score stand or fall together. The threshold lies midway to the next lower score, so that
    rounding on another machine moves no detection across it; `score >= threshold` counts as detected.

    Returns:
        (threshold, f1); (1.0, 0.0) when nothing was hit.
    """
    scores = curve.scores
    if not len(scores) or curve.vehicle_count == 0 or float(curve.recall[-1]) == 0:
        return 1.0, 0.0
    next_lower = torch.cat(
        [scores[1:], scores.new_tensor([min(LOWEST_SCORE, float(scores[-1]) / 2)])]
    )
    f1 = 2 * curve.precision * curve.recall / (curve.precision + curve.recall).clamp(min=1e-12)
    f1 = f1.masked_fill(next_lower == scores, -1.0)
    best = int(f1.argmax())
    return float((scores[best] + next_lower[best]) / 2), float(f1[best])


def _interpolated(precision: Tensor, recall: Tensor) -> float:
    """Mean over recalls 0, 0.01 … 1 of the best precision at that recall or beyond; 0 where it is not reached."""
    envelope = torch.cat([precision.flip(0).cummax(0).values.flip(0), precision.new_zeros(1)])
    levels = torch.linspace(0, 1, 101, dtype=torch.float64)
    return float(envelope[torch.searchsorted(recall.contiguous(), levels)].mean())
