"""How good detectors are on images without camouflage, photographs above all (PAPER 17)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import average_precision
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.matching import match_detections
from skyproof.results.clean_intervals import ap_interval

__all__ = ["CleanSet", "check_clean"]


@dataclass(frozen=True)
class CleanSet:
    """Images without camouflage that say how good the detectors are.

    Attributes:
        name: as the report shows it.
        images: in memory, at the detectors' resolution.
        note: where they come from and what was done to them.
        places: per image which place it shows: the clusters of the bootstrap (PAPER 40); empty where not known.
        real: whether a camera took them; False for rendered ones.
    """

    name: str
    images: Dataset
    note: str = ""
    places: Sequence[str] = ()
    real: bool = True


def check_clean(
    judge: LoadedDetector[Detector],
    clean: CleanSet,
    found: Sequence[Detections],
    *,
    generator: np.random.Generator,
) -> dict[str, Any]:
    """Average precision, and precision and recall at the frozen threshold, on images without camouflage.

    The interval of the average precision is over places; over images where all show one place, or none is known.
    """
    images = clean.images
    hits = alarms = 0
    for boxes, ignore, each in zip(images.boxes, images.ignore, found, strict=True):
        kept = each.scores >= judge.threshold
        matches = match_detections(
            each.boxes[kept],
            each.scores[kept],
            boxes,
            criterion="centre_1m",
            gsd_m=images.gsd_m,
            ignore=ignore,
        )
        matched = matches.truth_of_detection >= 0
        hits += int(matched.sum())
        alarms += int((~matched & ~matches.ignored).sum())
    vehicles = sum(len(boxes) for boxes in images.boxes)
    by_place = len(set(clean.places)) > 1
    clusters = list(clean.places) if by_place else list(map(str, range(len(images))))
    ap, low, high = ap_interval(found, images, clusters, criterion="centre_1m", generator=generator)
    return {
        "detector": judge.name,
        "dataset": clean.name,
        "images": len(images),
        "vehicles": vehicles,
        "real": clean.real,
        "ap_centre_1m": _defined(ap),
        "ap_centre_1m_low": _defined(low),
        "ap_centre_1m_high": _defined(high),
        "clustered_by": "places" if by_place else "images",
        "clusters": len(set(clusters)),
        "ap_iou_50": _defined(average_precision(found, images, criterion="iou_50").ap),
        "precision": hits / (hits + alarms) if hits + alarms else None,
        "recall": hits / vehicles if vehicles else None,
        "threshold": judge.threshold,
        "note": clean.note,
    }


def _defined(value: float) -> float | None:
    return None if math.isnan(value) else value
