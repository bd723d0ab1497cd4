"""Detectors as folders: `weights.safetensors` and `detector.json` (no pickle)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import torch
from torch import nn

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.answers import Answering
from skyproof.detectors.build import DETECTOR_NAMES, build_detector
from skyproof.detectors.card import DetectorCard, read_card_and_digest, write_card
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.reference_detectors import detector_folder, reinstalled
from skyproof.detectors.settings import SIZES
from skyproof.detectors.weights import plain_state, weights_digest
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import inside, write_bytes
from skyproof.storage import read_tensors, write_tensors

DetectorT_co = TypeVar("DetectorT_co", bound=Detector, covariant=True)


@dataclass(frozen=True)
class LoadedDetector(Generic[DetectorT_co]):
    """A detector and its card: the object that finds vehicles, and the meaning of its scores.

    `load_detector` makes one from a folder or from a callable.

    Attributes:
        detector: the network, or any object with `detect`.
        card: its name, frozen threshold, resolution and origin.
    """

    detector: DetectorT_co
    card: DetectorCard

    @property
    def name(self) -> str:
        """The detector's name in tables and file names."""
        return self.card.name

    @property
    def threshold(self) -> float:
        """The frozen score at or above which a detection counts."""
        return self.card.threshold


def save_detector(folder: Path, detector: TrainableDetector, card: DetectorCard) -> None:
    """Writes the folder; `detector.json` comes last, so a folder that has it is complete.

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    folder = Path(folder)
    write_tensors(folder / "weights.safetensors", plain_state(detector))
    # The digest ties both files together, so that a foreign weights file is noticed.
    write_card(folder / "detector.json", card, weights_digest(detector))


def copy_detector(folder: Path, out: Path, also: Sequence[str] = ()) -> None:
    """Copies the files of a detector, and those of `also` that exist; the card comes last.

    `out` is a `finished_folder`, so that it appears complete or not at all.

    Raises:
        StoredFileError: a file is a link that leads out of the folder.
        RunFolderError: the disk is full or not writable.
    """
    for name in ("weights.safetensors", *also, "detector.json"):
        file = inside(folder, name, folder)
        if file.is_file():
            write_bytes(out / name, file.read_bytes())


@overload
def load_detector(detector: str | Path) -> LoadedDetector[TrainableDetector]: ...
@overload
def load_detector(
    detector: Answering, labelled: Dataset, *, name: str | None = None
) -> LoadedDetector[Detector]: ...
def load_detector(
    detector: str | Path | Answering, labelled: Dataset | None = None, *, name: str | None = None
) -> LoadedDetector[Any]:
    """Opens a detector folder on the CPU, or wraps a callable of somebody else's.

    Args:
        detector: a detector folder, "retinanet" or "faster_rcnn"; or a callable, which takes sRGB
            images `[B, 3, H, W]` in [0, 1] and returns boxes `[K, 4]` (left, top, right, bottom in
            pixels) and scores `[K]` of each image.
        labelled: images on which a callable's threshold is frozen.
        name: name of a callable in tables; its own `name` or `__name__` if None.

    Raises:
        StoredFileError: a file is missing, damaged, of another format, or the tensors do not fit.
        ConfigurationError: the folder holds a YOLOv5 and the yolo extra is missing, or a callable
            has no name or finds no vehicle.
    """
    if not isinstance(detector, str | Path):
        from skyproof.detectors.black_box import open_black_box

        return open_black_box(detector, labelled, name)
    place = detector_folder(detector)
    with reinstalled(place):
        return _load(place)


def _load(folder: Path) -> LoadedDetector[TrainableDetector]:
    card, stored_digest = read_card_and_digest(folder / "detector.json")
    path = folder / "weights.safetensors"
    tensors, _ = read_tensors(path, "copy the whole folder again, or train the detector again")
    try:
        detector = _of_card(card)
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
    if weights_digest(detector) != stored_digest:
        raise StoredFileError(
            f"{path} is not the file that detector.json was written for; copy the whole folder "
            "again."
        )
    return LoadedDetector(detector.eval(), card)


Load = Callable[[Path], LoadedDetector[Any]]
"""Opens the detector of a folder: `load_detector`, or a function that also opens black boxes."""


def load_ensemble(
    folders: Sequence[Path],
    device: torch.device | str,
    gsd_m: float,
    load: Load | None = None,
) -> list[LoadedDetector[Any]]:
    """Loads detectors that will see the same images, onto the device they will run on.

    `load` opens a detector that a folder alone does not hold.

    Raises:
        ConfigurationError: two share a name, or one has another resolution than the images.
        StoredFileError: a folder is missing, damaged or of another version.
    """
    ensemble: list[LoadedDetector[Any]] = []
    for folder in folders:
        loaded = (load or load_detector)(folder)
        if any(loaded.name == other.name for other in ensemble):
            raise ConfigurationError(
                f"{folder} is a second {loaded.name}; give each kind of detector once."
            )
        if not math.isclose(loaded.card.gsd_m, gsd_m):
            raise ConfigurationError(
                f"{folder} was trained at {loaded.card.gsd_m} m per pixel but the images have "
                f"{gsd_m} m; give a detector and images of one resolution."
            )
        if isinstance(loaded.detector, nn.Module):
            # Convolutions on a CPU are faster in this layout.
            loaded.detector.to(device).to(memory_format=torch.channels_last)
        ensemble.append(loaded)
    return ensemble


def load_apart(
    folders: Sequence[Path],
    device: torch.device | str,
    gsd_m: float,
    load: Load | None = None,
) -> list[LoadedDetector[Any]]:
    """Loads detectors that are used one by one; detectors of one kind take their folders' names.

    Raises:
        ConfigurationError: a detector has another resolution than the images.
        StoredFileError: a folder is missing, damaged or of another version.
    """
    judges = [load_ensemble([folder], device, gsd_m, load)[0] for folder in folders]
    names = [judge.name for judge in judges]
    return [
        judge
        if names.count(judge.name) == 1
        else LoadedDetector(judge.detector, replace(judge.card, name=folder.name))
        for folder, judge in zip(folders, judges, strict=True)
    ]


def _of_card(card: DetectorCard) -> TrainableDetector:
    if card.brought is None:
        return build_detector(card.name, card.size, generator=torch.Generator())
    from skyproof.detectors.imported import ImportedDetector

    return ImportedDetector(card.name, card.brought)
