"""Validation of a detector on labelled images, and the threshold that it freezes."""

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import (
    average_precision,
    frozen_threshold,
    precision_recall,
)
from skyproof.detectors.card import DetectorCard, installed_version
from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import WINDOW_PX, detect_all
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError


def validate(detector: Detector, validation: Dataset) -> dict[str, float]:
    """Measures a detector on labelled images.

    Returns:
        "ap_centre_1m" and "ap_iou_50"; the "threshold" to freeze, and its "f1" by centres.
    """
    detections = detect_all(detector, validation)
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
    """Freezes a detector's threshold on labelled images, and returns its card.

    `remedy` is the advice to a detector that finds nothing.

    Raises:
        ConfigurationError: no vehicle is labelled, or the detector finds none.
    """
    check_validation(labelled)
    scores = validate(detector, labelled)
    threshold = scores.pop("threshold")
    vehicles = sum(map(len, labelled.boxes))
    if not scores["f1"]:
        raise ConfigurationError(
            f"{detector.name} finds none of the {vehicles} labelled vehicles, so no threshold can "
            f"be frozen on them; {remedy}."
        )
    width_px, height_px = labelled.pictures[0].size_px
    return DetectorCard(
        name=detector.name,
        threshold=threshold,
        gsd_m=labelled.gsd_m,
        image_size_px=(min(height_px, WINDOW_PX), min(width_px, WINDOW_PX)),
        validation=scores,
        validation_vehicles=vehicles,
        skyproof_version=installed_version(),
    )
