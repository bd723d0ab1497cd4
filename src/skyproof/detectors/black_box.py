"""A callable as a detector with a card, whose threshold is frozen on labelled images."""

from __future__ import annotations

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard, installed_version
from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import WINDOW_PX
from skyproof.detectors.training import check_validation, validate
from skyproof.errors import ConfigurationError


def open_black_box(
    detector: object, labelled: Dataset | None, name: str | None = None
) -> BlackBoxDetector:
    """Freezes a callable's threshold on labelled images; see `BlackBoxDetector`.

    Raises:
        ConfigurationError: the callable has no plain name, no image or vehicle is given, or it
            finds none.
        DetectorAnswerError: it does not answer, or its answer is impossible.
    """
    black_box = BlackBoxDetector(detector, name)
    if labelled is None:
        raise ConfigurationError(
            f"The threshold of {black_box.name} is frozen on labelled images, got none; give a "
            "Dataset."
        )
    black_box.set_card(frozen_card(black_box, labelled))
    return black_box


def frozen_card(detector: Detector, labelled: Dataset) -> DetectorCard:
    """Freezes a black-box detector's threshold on labelled images.

    Raises:
        ConfigurationError: no vehicle is labelled, or the detector finds none.
    """
    check_validation(labelled)
    scores = validate(detector, labelled)
    threshold = scores.pop("threshold")
    vehicles = sum(map(len, labelled.boxes))
    if not scores["f1"]:
        raise ConfigurationError(
            f"{detector.name} finds none of the {vehicles} vehicles of the labelled images, so no "
            "threshold can be frozen on them; check that its boxes are left, top, right, bottom in "
            "pixels."
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
