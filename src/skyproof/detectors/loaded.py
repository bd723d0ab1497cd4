"""Builds untrained detectors; stores and loads folders of weights and `detector.json`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import Answering, BlackBoxDetector
from skyproof.detectors.card import (
    PARENT_FILE,
    DetectorCard,
    detector_folder,
    read_card,
    reinstalled,
    write_card,
)
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.settings import DETECTOR_NAMES, SIZES
from skyproof.detectors.validation import frozen_card
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, inside, write_bytes
from skyproof.storage import read_tensors, write_tensors


def build_detector(name: str, size: str, *, generator: torch.Generator) -> TrainableDetector:
    """Builds an untrained detector on the CPU; its initial weights depend on `generator` alone.

    `size` is "slim" (about 1 to 2.5 M parameters, for a CPU) or "full" (9 to 43 M, for a GPU).
    """
    if name not in DETECTOR_NAMES:
        raise ConfigurationError(
            f"{name[:100]!r} is no detector; choose from {', '.join(DETECTOR_NAMES)}."
        )
    if size not in SIZES:
        raise ConfigurationError(
            f"expected a detector size out of {', '.join(SIZES)}, got {size[:100]!r}."
        )
    seed = int(torch.randint(2**62, (1,), generator=generator))
    # The libraries draw initial weights from torch's global generator: it is seeded here, and its
    # state is restored afterwards.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        # Late imports, so that matching and average precision do not load the networks.
        if name == "yolov5":
            from skyproof.detectors.ultralytics_detectors import YoloV5Detector

            return YoloV5Detector(size)
        from skyproof.detectors.torchvision_detectors import FasterRcnnDetector, RetinaNetDetector

        return RetinaNetDetector(size) if name == "retinanet" else FasterRcnnDetector(size)


def save_detector(folder: Path, detector: TrainableDetector, card: DetectorCard) -> None:
    """Writes the folder; `detector.json` comes last, so a folder that has it is complete."""
    write_tensors(folder / "weights.safetensors", detector.state_dict())
    # The digest ties both files together, so that a foreign weights file is noticed.
    write_card(folder / "detector.json", replace(card, weights_sha256=detector.weights_sha256))


def copy_detector(folder: Path, out: Path, also: Sequence[str] = ()) -> None:
    """Copies a detector's files, and those of `also` that exist; refuses links out of it."""
    for name in ("weights.safetensors", PARENT_FILE, *also, "detector.json"):
        file = inside(folder, name, folder)
        if file.is_file():
            write_bytes(out / name, file.read_bytes())


@overload
def load_detector(detector: str | Path) -> TrainableDetector: ...
@overload
def load_detector(
    detector: Answering, labelled: Dataset, *, name: str | None = None
) -> BlackBoxDetector: ...
def load_detector(
    detector: str | Path | Answering, labelled: Dataset | None = None, *, name: str | None = None
) -> TrainableDetector | BlackBoxDetector:
    """Opens a detector folder on the CPU, or wraps a callable of yours.

    Args:
        detector: a detector folder, "retinanet" or "faster_rcnn"; or a callable, which takes sRGB
            images `[B, 3, H, W]` in [0, 1] and returns boxes `[K, 4]` (left, top, right, bottom in
            pixels) and scores `[K]` of each image.
        labelled: images on which a callable's threshold is frozen.
        name: name of a callable in tables; its own `name` or `__name__` if None.

    Raises:
        StoredFileError: a file is missing, damaged, of another format, or the tensors do not fit.
        ConfigurationError: the folder holds a YOLOv5 and the yolo extra is missing, or a callable
            has no name, finds no vehicle, or answers with several classes.
    """
    if not isinstance(detector, str | Path):
        black_box = BlackBoxDetector(detector, name)
        black_box.freeze(labelled)
        return black_box
    place = detector_folder(detector)
    card = read_card(place)
    with reinstalled(place):
        return _load(place, card)


def _load(folder: Path, card: DetectorCard) -> TrainableDetector:
    path = folder / "weights.safetensors"
    tensors, _ = read_tensors(path, "copy the whole folder again, or train the detector again")
    try:
        detector: TrainableDetector
        if card.brought is None:
            detector = build_detector(card.name, card.size, generator=torch.Generator())
        else:
            from skyproof.detectors.imported import ImportedDetector

            detector = ImportedDetector(card.name, card.brought)
    except ConfigurationError as error:
        if card.brought is None and card.name in DETECTOR_NAMES and card.size in SIZES:
            raise
        raise StoredFileError(
            f"{folder / 'detector.json'} names an unknown detector: {error}"
        ) from error
    try:
        # BatchNorm silently fills in a missing counter, even in a strict load.
        if tensors.keys() != detector.state_dict().keys():
            raise RuntimeError("other tensor names")
        # Half precision is widened here; the digest covers the widened numbers.
        detector.load_state_dict(tensors)
    except RuntimeError as error:
        raise StoredFileError(
            f"{path} does not fit a {card.size} {card.name} of this version; copy the whole folder "
            "again, or train or import the detector again."
        ) from error
    if detector.weights_sha256 != card.weights_sha256:
        raise StoredFileError(
            f"{path} is not the file that detector.json was written for; copy the whole folder "
            "again."
        )
    detector.set_card(card)
    return detector.eval()


def load_ensemble(
    folders: Sequence[Path], device: torch.device | str, gsd_m: float, *, apart: bool = False
) -> list[TrainableDetector]:
    """Loads detectors of one resolution; with `apart`, several of a kind are named by folder."""
    ensemble: list[TrainableDetector] = []
    for folder in folders:
        detector = load_detector(folder)
        if not apart and any(detector.name == other.name for other in ensemble):
            raise ConfigurationError(
                f"{folder} is a second {detector.name}; give each kind of detector once."
            )
        if not math.isclose(detector.card.gsd_m, gsd_m):
            raise ConfigurationError(
                f"{folder} was trained at {detector.card.gsd_m} m per pixel but the images have "
                f"{gsd_m} m; give a detector and images of one resolution."
            )
        # Convolutions on a CPU are faster in this layout.
        ensemble.append(detector.to(device).to(memory_format=torch.channels_last))
    names = [detector.name for detector in ensemble]
    for folder, detector in zip(folders, ensemble, strict=True):
        if names.count(detector.name) > 1:
            detector.set_card(replace(detector.card, name=folder.name))
    return ensemble


def copy_with_threshold(
    folder: Path, labelled: Mapping[str, Dataset], out: Path, device: torch.device | str
) -> str:
    """Copies a detector with a threshold frozen on labelled images; returns a sentence on it."""
    with finished_folder(out) as partial:
        copy_detector(detector_folder(folder), partial)
        (detector,) = load_ensemble([folder], device, read_card(folder).gsd_m)
        remedy = "give other frames, or train it longer or on more images"
        frozen = frozen_card(detector, Dataset.joined(list(labelled.values())), remedy)
        how = f"the middle of those within a point of the best F1 on {', '.join(labelled)}"
        card = replace(
            detector.card,
            threshold=frozen.threshold,
            threshold_from=how,
            validation=frozen.validation,
            validation_vehicles=frozen.validation_vehicles,
        )
        write_card(partial / "detector.json", card)
    return f"Threshold {card.threshold:.3f} instead of {detector.threshold:.3f}: {how}."
