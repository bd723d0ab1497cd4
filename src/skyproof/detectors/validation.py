"""Validation of a detector: precision and recall, average precision, and the frozen threshold."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof import __version__
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import LEAST_AP, DetectorCard
from skyproof.detectors.detector import LOWEST_SCORE, WINDOW_PX, Detections, Detector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.errors import ConfigurationError

# Validation images cannot tell thresholds apart if their F1 differs by no more than this: about
# twice the standard error of F1 on 500 vehicles.
_FLAT_F1 = 0.01
# An average precision that boxes do not reach by chance if they are read in a wrong way.
_MISPLACED_AP = 0.5
# Other readings of four numbers that look like boxes; each gets width and height twice.
_READINGS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "top, left, bottom, right": lambda boxes, _: boxes[:, [1, 0, 3, 2]],
    "fractions of the image's sides": lambda boxes, sides_px: boxes * sides_px,
}
# Computed as COCO does, because at a recall of exactly 0.7 the last bit decides.
_LEVELS = np.linspace(0, 1, 101)


class PrecisionRecall(NamedTuple):
    """Precision and recall if every detection down to each falling score counts."""

    scores: Float[np.ndarray, " K"]
    precision: Float[np.ndarray, " K"]
    recall: Float[np.ndarray, " K"]
    vehicles: int


def precision_recall(
    matches: MatchTable, image_weights: Int[np.ndarray, " images"] | None = None
) -> PrecisionRecall:
    """The curve of a matched set; `image_weights` says how often each image counts (once)."""
    if image_weights is None:
        image_weights = np.ones(matches.images, dtype=np.int64)
    occurrences = image_weights[matches.image_of_detection]
    vehicles = int(image_weights[matches.image_of_vehicle].sum())
    true_positives = np.cumsum(occurrences * matches.hits)
    return PrecisionRecall(
        scores=matches.scores.astype(np.float64),
        # Precision is undefined before the first detection that occurs.
        precision=true_positives / np.maximum(np.cumsum(occurrences), 1),
        recall=true_positives / max(vehicles, 1),
        vehicles=vehicles,
    )


def average_precision(
    matches: MatchTable, image_weights: Int[np.ndarray, " images"] | None = None
) -> float:
    """COCO's 101-point interpolated average precision, 0 to 1; nan if there is no vehicle.

    It is the mean over recalls 0, 0.01 … 1 of the best precision at that recall or beyond, 0 for a
    recall that is not reached. With "iou_50" and without ignore regions it equals COCO's AP at IoU
    0.5 (one class, all areas, 100 detections); COCO has no centre criterion.
    """
    curve = precision_recall(matches, image_weights)
    if not curve.vehicles:
        return float("nan")
    envelope = np.append(np.maximum.accumulate(curve.precision[::-1])[::-1], 0.0)
    precisions = envelope[np.searchsorted(curve.recall, _LEVELS)]
    # Torch's mean, because NumPy's rounds differently in the last bit.
    return float(torch.from_numpy(precisions).mean())


def best_f1_threshold(curve: PrecisionRecall) -> tuple[float, float]:
    """Returns the threshold of the largest F1, and that F1; (1.0, 0.0) if no vehicle was found.

    Detections of equal score count together. The threshold lies midway to the next lower score, so
    that rounding on another machine moves no detection across it.
    """
    thresholds, f1 = _f1(curve)
    best = int(np.argmax(f1))
    return float(thresholds[best]), float(f1[best])


def frozen_threshold(curve: PrecisionRecall) -> tuple[float, float]:
    """Returns the threshold to freeze, the middle of those with the best F1, and its F1.

    The best thresholds have an F1 within one point of the largest: a good detector's F1 is flat
    over a wide range of scores, and chance decides where its peak lies. Drawn anew from 360 images,
    the peak of a Faster R-CNN moved by 0.12 (standard deviation), this middle by 0.02
    (docs/results/detectors). If few vehicles leave steps larger than a point, the peak is returned.

    Difference from the paper: the paper does not say how it chose its thresholds.
    """
    thresholds, f1 = _f1(curve)
    good = np.flatnonzero(f1 >= f1.max() - _FLAT_F1)
    middle = (thresholds[good[0]] + thresholds[good[-1]]) / 2
    chosen = int(np.flatnonzero((thresholds >= middle) & (f1 >= 0))[-1])
    return float(thresholds[chosen]), float(f1[chosen])


def _f1(curve: PrecisionRecall) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Falling thresholds and their F1, -1 where one would part equal scores."""
    scores = curve.scores
    if not len(scores) or curve.vehicles == 0 or float(curve.recall[-1]) == 0:
        return np.ones(1), np.zeros(1)
    next_lower = np.append(scores[1:], min(LOWEST_SCORE, float(scores[-1]) / 2))
    total = np.maximum(curve.precision + curve.recall, 1e-12)
    f1 = 2 * curve.precision * curve.recall / total
    return (scores + next_lower) / 2, np.where(next_lower == scores, -1.0, f1)


def validate(detector: Detector, validation: Dataset) -> dict[str, float]:
    """Measures "ap_centre_1m", "ap_iou_50", the "threshold" to freeze, and its "f1" by centres."""
    return _scores(detect_all(detector, validation), validation)


def _scores(detections: Sequence[Detections], validation: Dataset) -> dict[str, float]:
    centre = match_images(detections, validation, criterion="centre_1m")
    overlap = match_images(detections, validation, criterion="iou_50")
    threshold, f1 = frozen_threshold(precision_recall(centre))
    return {
        "ap_centre_1m": average_precision(centre),
        "ap_iou_50": average_precision(overlap),
        "f1": f1,
        "threshold": threshold,
    }


def check_validation(validation: Dataset) -> None:
    """Refuses images that cannot give a threshold."""
    if not any(len(boxes) for boxes in validation.boxes):
        raise ConfigurationError(
            "Validation expects at least one vehicle, to choose a threshold by; give images "
            "with some."
        )


def frozen_card(detector: Detector, labelled: Dataset, remedy: str) -> DetectorCard:
    """Freezes a detector's threshold; `remedy` is the advice for one that finds nothing."""
    check_validation(labelled)
    detections = detect_all(detector, labelled)
    scores = _scores(detections, labelled)
    threshold = scores.pop("threshold")
    vehicles = sum(map(len, labelled.boxes))
    if scores["ap_centre_1m"] < LEAST_AP:
        _refuse_misplaced(detector.name, detections, labelled)
    if not scores["f1"]:
        raise ConfigurationError(
            f"{detector.name} finds none of the {vehicles} labelled vehicles{_sizes(detections)}, "
            f"so no threshold can be frozen on them; {remedy}."
        )
    width_px, height_px = labelled.pictures[0].size_px
    return DetectorCard(
        name=detector.name,
        threshold=threshold,
        gsd_m=labelled.gsd_m,
        image_size_px=(min(height_px, WINDOW_PX), min(width_px, WINDOW_PX)),
        validation=scores,
        validation_vehicles=vehicles,
        skyproof_version=__version__,
    )


def _refuse_misplaced(name: str, detections: Sequence[Detections], labelled: Dataset) -> None:
    """Refuses boxes that lie on the vehicles only if they are read in another way."""
    for words, read in _READINGS.items():
        moved = [
            replace(found, boxes=read(found.boxes, torch.tensor(size_px * 2)).float())
            for found, size_px in zip(detections, labelled.sizes_px, strict=True)
        ]
        ap = average_precision(match_images(moved, labelled, criterion="centre_1m"))
        if ap > _MISPLACED_AP:
            raise ConfigurationError(
                f"The boxes of {name} lie on the labelled vehicles if they are read as {words} "
                f"(AP {ap:.2f}), but skyproof reads left, top, right, bottom in pixels; convert "
                "them."
            )


def _sizes(detections: Sequence[Detections]) -> str:
    boxes = torch.cat([found.boxes for found in detections])
    if not len(boxes):
        return ""
    width, height = (boxes[:, 2:] - boxes[:, :2]).median(dim=0).values.tolist()
    return f" (its {len(boxes):,} boxes are about {width:.3g} x {height:.3g} px)"
