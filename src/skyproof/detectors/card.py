"""The description of a detector in its folder, `detector.json`. Imports no torch."""

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
# The name of the average of all detectors in tables.
_TAKEN = ("mean",)


@dataclass(frozen=True)
class DetectorCard:
    """The known facts about a detector. A black box needs a name, a threshold and a resolution.

    Attributes:
        name: name in tables: one of `DETECTOR_NAMES` for ours, the given name for another detector.
        size: "slim" or "full" for ours, "brought" for an imported one, empty for a black box.
        threshold: frozen score threshold, chosen by F1 on validation images unless `threshold_from`
            says otherwise; see `frozen_threshold`.
        gsd_m: metres per pixel of its input images.
        image_size_px: height and width of the first training image, at most those of a training
            window; those of the first validation image for an imported detector.
        parameters: number of trained parameters.
        training: settings and progress, as `train` writes them; empty for an imported one.
        validation: "ap_centre_1m", "ap_iou_50" and "f1" (centre), each 0 to 1.
        validation_vehicles: number of vehicles in the validation images; None if not known.
        skyproof_version: version that wrote the card.
        trained_on: short description of the training images; empty if not known.
        threshold_from: source of the threshold, if it was frozen anew.
        brought: blueprint of an imported detector; else None.

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
    # Older cards have no count.
    validation_vehicles: WholeNumber | None = None
    skyproof_version: _Word = ""
    trained_on: Annotated[str, Meta(max_length=10_000)] = ""
    threshold_from: Annotated[str, Meta(max_length=10_000)] = ""
    brought: Blueprint | None = None

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def doubts(self) -> list[str]:
        """The reasons not to attack the detector at all, one sentence each; see `find_doubts`."""
        return find_doubts(
            self.name,
            imported=self.brought is not None,
            ap_centre_1m=self.validation.get("ap_centre_1m"),
            vehicles=self.validation_vehicles,
        )


@dataclass(frozen=True)
class _Stored(DetectorCard):
    """The content of `detector.json`: the card, and the digest that ties it to the weights."""

    format: int = field(kw_only=True)
    weights_sha256: Annotated[str, Meta(max_length=64)] = field(kw_only=True)


def write_card(path: Path, card: DetectorCard, weights_sha256: str) -> None:
    """Writes `detector.json` with the digest of the weights it belongs to.

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
    """Reads `detector.json` with the digest of the weights it belongs to.

    Raises:
        StoredFileError: the file is missing, damaged, or of another format, or its folder is a
            file.
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
    """skyproof's version, or "unknown" if it runs from sources that are not installed."""
    try:
        return version("skyproof")
    except PackageNotFoundError:
        return "unknown"


def require_detector_name(name: str, remedy: str) -> None:
    """Refuses a detector name that tables or files cannot use; `remedy` is the error's advice.

    Raises:
        ConfigurationError: the name is not valid, or taken.
    """
    if not _NAME.fullmatch(name) or not is_name(name) or name in _TAKEN:
        raise ConfigurationError(
            f"{name[:200]!r} is no name for a detector: at most 150 letters, digits, . _ - are, "
            f"and {' and '.join(_TAKEN)} is taken; {remedy}."
        )
