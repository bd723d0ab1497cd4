"""What a detector folder says of itself in `detector.json`. Imports no torch."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.doubts import find_doubts
from skyproof.detectors.reference_detectors import detector_folder, reinstalled
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import write_json
from skyproof.ranges import (
    Fraction,
    GroundResolution,
    Name,
    WholeNumber,
    check_ranges,
    is_name,
)

FOLDER_FORMAT = 1
_REMEDY = "copy the whole folder again, or train or import the detector again"

_Side = Annotated[int, Meta(ge=0, le=16_384)]
_Word = Annotated[str, Meta(max_length=100)]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
# What tables call the average of all detectors.
_TAKEN = ("mean",)


@dataclass(frozen=True)
class DetectorCard:
    """What is known of a detector. A black box needs a name, a threshold and a resolution.

    Attributes:
        name: as tables show it: of ours one of `DETECTOR_NAMES`; of another detector the name it
            was given.
        size: "slim" or "full" of ours, "brought" of an imported one, empty of a black box.
        threshold: frozen score threshold, chosen by F1 on clean validation images where
            `threshold_from` says nothing else; see `frozen_threshold`.
        gsd_m: metres per pixel of the images it takes.
        image_size_px: height and width of the first training image, at most those of a training
            window; of an imported detector, of the first validation image.
        parameters: number of trained numbers.
        training: settings and what was reached, as written by `train`; empty of an imported one.
        validation: "ap_centre_1m", "ap_iou_50" and "f1" (centre), each 0 to 1.
        validation_vehicles: how many vehicles the validation images hold; None where not known.
        skyproof_version: that wrote it.
        trained_on: what its training images were, in a few words; empty where not known.
        threshold_from: what the threshold was chosen on, where it was frozen anew.
        brought: of an imported detector what builds its network; else None.

    Raises:
        ConfigurationError: a value out of its range, such as a threshold in percent.
    """

    name: Name
    size: _Word = ""
    threshold: Fraction = field(kw_only=True)
    gsd_m: GroundResolution = field(kw_only=True)
    image_size_px: tuple[_Side, _Side] = (0, 0)
    parameters: Annotated[int, Meta(ge=0, le=10**12)] = 0
    training: dict[str, Any] = field(default_factory=dict)
    validation: dict[str, Fraction] = field(default_factory=dict)
    # Cards written before they were counted have none.
    validation_vehicles: WholeNumber | None = None
    skyproof_version: _Word = ""
    trained_on: Annotated[str, Meta(max_length=10_000)] = ""
    threshold_from: Annotated[str, Meta(max_length=10_000)] = ""
    brought: Blueprint | None = None

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def doubts(self) -> list[str]:
        """What speaks against attacking it at all, in a sentence each; see `find_doubts`."""
        return find_doubts(
            self.name,
            imported=self.brought is not None,
            ap_centre_1m=self.validation.get("ap_centre_1m"),
            vehicles=self.validation_vehicles,
        )


@dataclass(frozen=True)
class _Stored(DetectorCard):
    """What `detector.json` holds: the card, and what ties it to the weights."""

    format: int = field(kw_only=True)
    weights_sha256: Annotated[str, Meta(max_length=64)] = field(kw_only=True)


def write_card(path: Path, card: DetectorCard, weights_sha256: str) -> None:
    """Writes `detector.json` with the digest of the weights that it belongs to.

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    record = {"format": FOLDER_FORMAT, **asdict(card), "weights_sha256": weights_sha256}
    write_json(path, record)


def read_card(folder: Path) -> DetectorCard:
    """Reads the card of a detector folder, or of a detector that comes with skyproof.

    Raises:
        StoredFileError: `detector.json` is missing, damaged, or of another format.
    """
    place = detector_folder(folder)
    with reinstalled(place):
        return read_card_and_digest(place / "detector.json")[0]


def read_card_and_digest(path: Path) -> tuple[DetectorCard, str]:
    """Reads `detector.json` with the digest of the weights that it belongs to.

    Raises:
        StoredFileError: the file is missing, damaged, or of another format, or what should be its
            folder is a file.
    """
    if path.parent.is_file():
        raise StoredFileError(
            f"{path.parent} is a file and no detector folder; make one of a checkpoint with "
            "skyproof import, and give that."
        )
    stored: _Stored = read_document(path, _Stored, _REMEDY, version=FOLDER_FORMAT)
    card = DetectorCard(**{each.name: getattr(stored, each.name) for each in fields(DetectorCard)})
    return card, stored.weights_sha256


def installed_version() -> str:
    """skyproof's version, or "unknown" when it runs from sources that were not installed."""
    try:
        return version("skyproof")
    except PackageNotFoundError:
        return "unknown"


def require_detector_name(name: str, remedy: str) -> None:
    """Refuses what tables and files cannot call a detector.

    Args:
        name: that it is to have.
        remedy: what to do instead.

    Raises:
        ConfigurationError: it is no such name, or taken.
    """
    if not _NAME.fullmatch(name) or not is_name(name) or name in _TAKEN:
        raise ConfigurationError(
            f"{name[:200]!r} is no name for a detector: at most 150 letters, digits, . _ - are, "
            f"and {' and '.join(_TAKEN)} is taken; {remedy}."
        )
