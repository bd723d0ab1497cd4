"""Freezes another threshold, if that of the card does not suit the imagery at hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from skyproof.datasets.annotations import ANNOTATIONS, AnnotationFile, read_annotations
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import PictureFile
from skyproof.detectors.average_precision import frozen_threshold, precision_recall
from skyproof.detectors.detector import LOWEST_SCORE, Detector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import LoadedDetector
from skyproof.detectors.matching import match_images
from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet

Judge = LoadedDetector[Detector]


def threshold_of_labels(judge: Judge, frames: Sequence[Dataset]) -> float:
    """Returns the threshold to freeze by F1 (centre within 1 m) on labelled images.

    Raises:
        ConfigurationError: there is no vehicle, or the detector finds none.
    """
    images = Dataset.joined(frames)
    matches = match_images(detect_all(judge.detector, images), images, criterion="centre_1m")
    threshold, f1 = frozen_threshold(precision_recall(matches))
    if not f1:
        raise ConfigurationError(
            f"{judge.name} finds none of the {matches.vehicles} labelled vehicles, so no threshold "
            "can be frozen on them; give other frames, or train it longer or on more images."
        )
    return threshold


def threshold_of_alarms(judge: Judge, empty: Dataset, alarms_per_km2: float) -> float:
    """Returns the lowest threshold with at most so many false alarms per km² of empty ground.

    It lies midway to the next higher score, so that rounding moves no detection across it.

    Raises:
        ConfigurationError: the ground is too small to allow a single detection, or the detector is
            too sure of its false alarms.
    """
    pixels = sum(width * height for width, height in empty.sizes_px)
    area_km2 = pixels * empty.gsd_m**2 / 1e6
    allowed = int(alarms_per_km2 * area_km2)
    if not allowed:
        raise ConfigurationError(
            f"On {area_km2:.3g} km² of empty ground not even one detection would be "
            f"{alarms_per_km2:g} a km²; give at least {1 / alarms_per_km2:.2g} km², or allow more."
        )
    found = detect_all(judge.detector, empty)
    scores = np.sort(np.concatenate([each.scores.double().cpu().numpy() for each in found]))[::-1]
    if len(scores) <= allowed:
        return LOWEST_SCORE
    last = float(scores[allowed])
    higher = scores[scores > last]
    threshold = (last + (float(higher[-1]) if len(higher) else 1.0)) / 2
    if not threshold > last:
        raise ConfigurationError(
            f"{judge.name} gives its largest score to more than {allowed} places of empty ground, "
            "so no threshold leaves them out; train it on such ground."
        )
    return threshold


def empty_tiles(backgrounds: BackgroundSet) -> Dataset:
    """Returns the validation tiles of a background set without vehicles, as images.

    Raises:
        ConfigurationError: it has no validation tiles, or labelled vehicles on them.
        StoredFileError: their labels are damaged.
    """
    tiles = backgrounds.tiles("validation")
    if not tiles:
        raise ConfigurationError(
            f"{backgrounds.folder} has no validation tiles, on which thresholds are chosen; give "
            "a background set that has."
        )
    labels = backgrounds.folder / "validation"
    if (labels / ANNOTATIONS).is_file():
        document, _ = read_annotations(labels, AnnotationFile)
        vehicles = sum(not row.iscrowd for row in document.annotations)
        if vehicles:
            raise ConfigurationError(
                f"The validation tiles of {backgrounds.folder} have {vehicles} labelled vehicles, "
                "each of which would count as a false alarm; give what skyproof clear makes of it, "
                "or freeze on the labels (--freeze labels)."
            )
    none = [torch.zeros(0, 4)] * len(tiles)
    return Dataset(
        pictures=[
            PictureFile(backgrounds.folder / tile.file, (tile.width_px, tile.height_px))
            for tile in tiles
        ],
        boxes=none,
        ignore=none,
        ids=[tile.id for tile in tiles],
        gsd_m=backgrounds.gsd_m,
        visible_fractions=[torch.zeros(0)] * len(tiles),
    )
