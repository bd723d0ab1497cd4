"""Detectors that are Python objects, of which only the answers are known."""

from __future__ import annotations

from collections.abc import Sequence

from skyproof.detectors.answers import BlackBoxDetector
from skyproof.errors import ConfigurationError
from skyproof.maite.models import ModelDetector, is_maite_model


def checked_object(
    detector: object, name: str | None, vehicle_classes: Sequence[str], architecture: str | None
) -> BlackBoxDetector:
    """Returns the object as a detector, with its answers checked.

    Raises:
        ConfigurationError: it is not callable or has no plain name, or an option speaks of files.
    """
    of_files = {"architecture": architecture, "vehicle_classes": vehicle_classes}
    if is_maite_model(detector):
        del of_files["vehicle_classes"]
        detector = ModelDetector(detector, vehicle_classes=vehicle_classes)
    for option, value in of_files.items():
        if value:
            raise ConfigurationError(
                f"{option} is for checkpoint files, and the detector is an object, which decides "
                "it itself; leave the option out."
            )
    return BlackBoxDetector(detector, name)
