"""Precision and recall over a set of images, average precision, and thresholds by F1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from skyproof.detectors.detector import LOWEST_SCORE
from skyproof.detectors.matching import MatchTable

FLAT_F1 = 0.01
"""Thresholds whose F1 differs by no more are equally good, as far as validation images can tell."""

_LEVELS = torch.linspace(0, 1, 101, dtype=torch.float64).numpy()
"""Torch's, not NumPy's: at a recall of just 0.6 the last bit decides."""


@dataclass(frozen=True)
class PrecisionRecall:
    """Precision and recall when every detection down to each score counts.

    Attributes:
        scores: `[K]` falling; detections in ignore regions are left out.
        precision: `[K]`, 0 to 1.
        recall: `[K]`, 0 to 1.
        vehicles: how many true vehicles there are in all images.
    """

    scores: Float[np.ndarray, " K"]
    precision: Float[np.ndarray, " K"]
    recall: Float[np.ndarray, " K"]
    vehicles: int


def precision_recall(
    matches: MatchTable, image_weights: Int[np.ndarray, " images"] | None = None
) -> PrecisionRecall:
    """The curve of precision and recall of one matched set of images.

    Args:
        matches: the set, from `match_images`.
        image_weights: how often each image counts, as in a bootstrap replicate; once where None.
    """
    if image_weights is None:
        image_weights = np.ones(matches.images, dtype=np.int64)
    occurrences = image_weights[matches.image_of_detection]
    vehicles = int(image_weights[matches.image_of_vehicle].sum())
    true_positives = np.cumsum(occurrences * matches.hits)
    return PrecisionRecall(
        scores=matches.scores.astype(np.float64),
        # Before the first detection that occurs there is nothing to be precise about.
        precision=true_positives / np.maximum(np.cumsum(occurrences), 1),
        recall=true_positives / max(vehicles, 1),
        vehicles=vehicles,
    )


def average_precision(
    matches: MatchTable, image_weights: Int[np.ndarray, " images"] | None = None
) -> float:
    """COCO's 101-point interpolated average precision, 0 to 1; nan where there is no vehicle.

    The mean over recalls 0, 0.01 … 1 of the best precision at that recall or beyond, 0 where it is
    not reached. With "iou_50" it equals COCO's AP at IoU 0.5 (one class, all areas, 100
    detections) where there are no ignore regions; COCO has no centre criterion.

    Args:
        matches: a set of images, from `match_images`.
        image_weights: how often each image counts, as in a bootstrap replicate; once where None.
    """
    curve = precision_recall(matches, image_weights)
    if not curve.vehicles:
        return float("nan")
    envelope = np.append(np.maximum.accumulate(curve.precision[::-1])[::-1], 0.0)
    precisions = envelope[np.searchsorted(curve.recall, _LEVELS)]
    # Torch's mean, because NumPy's rounds differently in the last bit.
    return float(torch.from_numpy(precisions).mean())


def best_f1_threshold(curve: PrecisionRecall) -> tuple[float, float]:
    """The score threshold of the largest F1, and that F1.

    Detections of equal score stand or fall together. The threshold lies midway to the next lower
    score, so that rounding on another machine moves no detection across it; `score >= threshold`
    counts as detected.

    Returns:
        (threshold, f1); (1.0, 0.0) when nothing was hit.
    """
    return _lowest_within(curve, 0.0)


def frozen_threshold(curve: PrecisionRecall) -> tuple[float, float]:
    """The threshold that is frozen: the lowest whose F1 is within a point of the largest.

    The F1 of a detector that finds nearly all of its validation vehicles is flat over a wide range
    of scores, and which of them is the peak is chance: one vehicle more or less of 479 moved it
    from 0.79 to 0.95. The high end of that range looks as good on the renders it was chosen on, and
    loses vehicles everywhere else: 71 % instead of 87 % found on photographs
    (docs/results/detectors). A point is about twice the standard error of F1 on as many vehicles.

    Difference from the paper: it does not tell how its thresholds were chosen.

    Returns:
        (threshold, its F1); (1.0, 0.0) when nothing was hit.
    """
    return _lowest_within(curve, FLAT_F1)


def _lowest_within(curve: PrecisionRecall, tolerance: float) -> tuple[float, float]:
    scores = curve.scores
    if not len(scores) or curve.vehicles == 0 or float(curve.recall[-1]) == 0:
        return 1.0, 0.0
    next_lower = np.append(scores[1:], min(LOWEST_SCORE, float(scores[-1]) / 2))
    total = np.maximum(curve.precision + curve.recall, 1e-12)
    f1 = 2 * curve.precision * curve.recall / total
    f1 = np.where(next_lower == scores, -1.0, f1)
    # Of equals the highest is the largest F1's; with a tolerance the lowest counts.
    good = np.flatnonzero(f1 >= f1.max() - tolerance)
    chosen = int(good[-1] if tolerance else good[0])
    return float((scores[chosen] + next_lower[chosen]) / 2), float(f1[chosen])
