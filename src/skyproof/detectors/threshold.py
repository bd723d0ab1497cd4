"""Another frozen threshold, where that of the card does not carry over to the imagery at hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.average_precision import frozen_threshold, precision_recall
from skyproof.detectors.card import read_card
from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_ensemble, save_detector
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder


def threshold_of_labels(detector: Detector, labelled: Sequence[Dataset]) -> float:
    """Returns the threshold to freeze by F1 (centre within 1 m) on labelled images.

    Raises:
        ConfigurationError: there is no vehicle, or the detector finds none.
    """
    images = Dataset.joined(labelled)
    matches = match_images(detect_all(detector, images), images, criterion="centre_1m")
    threshold, f1 = frozen_threshold(precision_recall(matches))
    if not f1:
        raise ConfigurationError(
            f"{detector.name} finds none of the {matches.vehicles} labelled vehicles, so no "
            "threshold can be frozen on them; give other frames, or train it longer or on more "
            "images."
        )
    return threshold


def copy_with_threshold(
    folder: Path, labelled: Mapping[str, Dataset], out: Path, device: torch.device | str
) -> str:
    """Writes a copy of a detector folder with its threshold frozen on labelled images.

    Args:
        folder: the detector's; it stays as it is.
        labelled: sets of images, by the names that the card is to mention.
        out: folder to write, whole or not at all.
        device: where the detector runs.

    Returns:
        What was done, in a sentence.

    Raises:
        ConfigurationError: as `threshold_of_labels` does.
        StoredFileError: the folder is damaged.
        RunFolderError: `out` exists, or the disk cannot take it.
    """
    with finished_folder(out) as partial:
        (detector,) = load_ensemble([folder], device, read_card(folder).gsd_m)
        threshold = threshold_of_labels(detector, list(labelled.values()))
        how = f"the lowest within a point of the best F1 on labelled images ({', '.join(labelled)})"
        card = replace(detector.card, threshold=threshold, threshold_from=how)
        save_detector(partial, detector, card)
    return f"Threshold {threshold:.3f} instead of {detector.threshold:.3f}: {how}."
