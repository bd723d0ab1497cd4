"""The lines that a command prints about a new detector."""

from __future__ import annotations

from pathlib import Path

from skyproof.console import say
from skyproof.detectors.card import DetectorCard


def say_card(card: DetectorCard, folder: Path) -> None:
    """Prints how good a detector is on its validation images, and warnings."""
    say(
        f"Validation AP (centre within 1 m) {card.validation['ap_centre_1m']:.3f}, threshold "
        f"{card.threshold:.3f}. Detector: {folder.resolve()}"
    )
    for doubt in card.doubts:
        say(f"Warning: {doubt}")
