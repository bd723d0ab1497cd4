"""Detectors that are Python objects, of which only the answers are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import CheckedAnswers
from skyproof.detectors.card import DetectorCard, installed_version, write_card
from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import WINDOW_PX
from skyproof.detectors.training import check_validation, validate
from skyproof.errors import ConfigurationError
from skyproof.maite.models import ModelDetector, is_maite_model
from skyproof.ranges import is_name


def checked_object(
    detector: object, vehicle_classes: Sequence[str], architecture: str | None
) -> Detector:
    """Returns the object, with its answers checked.

    Raises:
        ConfigurationError: it has no name that can be a file's, or nothing to ask it by; or an
            option speaks of files.
    """
    of_files = {"architecture": architecture, "vehicle_classes": vehicle_classes}
    if is_maite_model(detector):
        of_files.pop("vehicle_classes")
    for option, value in of_files.items():
        if value:
            raise ConfigurationError(
                f"{option} is for checkpoint files, and the detector is an object, which decides "
                "it itself; leave the option out."
            )
    if is_maite_model(detector):
        detector = ModelDetector(detector, vehicle_classes=vehicle_classes)
    own = getattr(detector, "name", None)
    if not isinstance(detector, Detector) or not isinstance(own, str) or not is_name(own):
        raise ConfigurationError(
            "assess expects a folder, a file, a MAITE model, or an object with detect and a plain "
            f"name (no separators, not dots alone), got {type(detector).__name__} named "
            f"{str(own)[:100]!r}."
        )
    return CheckedAnswers(detector)


def freeze_object(detector: Detector, images: Dataset, folder: Path) -> DetectorCard:
    """Chooses a detector's threshold on labelled images, and writes its card.

    Raises:
        ConfigurationError: no vehicle is labelled, or it finds none.
        RunFolderError: the disk cannot take the card.
    """
    check_validation(images)
    scores = validate(detector, images)
    threshold = scores.pop("threshold")
    vehicles = sum(map(len, images.boxes))
    if not scores["f1"]:
        raise ConfigurationError(
            f"{detector.name} finds none of the {vehicles} vehicles of the validation images, so "
            "no threshold can be frozen on them; see that it gives pixel boxes, left, top, right, "
            "bottom."
        )
    width_px, height_px = images.pictures[0].size_px
    card = DetectorCard(
        name=detector.name,
        threshold=threshold,
        gsd_m=images.gsd_m,
        image_size_px=(min(height_px, WINDOW_PX), min(width_px, WINDOW_PX)),
        validation=scores,
        validation_vehicles=vehicles,
        skyproof_version=installed_version(),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_card(folder / "detector.json", card, "")
    return card
