"""The description of a detector in its folder, `detector.json`. Imports no torch."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.detectors.blueprint import FOLDER_WEIGHTS, Blueprint
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import write_json
from skyproof.ranges import Checked, Fraction, GroundResolution, Name, WholeNumber, is_name
from skyproof.words import detector_name, listed

REFERENCE_DETECTORS = ("retinanet", "faster_rcnn")
"""Those that ship trained. YOLOv5 does not, because its library has another licence."""

HARDENED_DETECTORS = ("retinanet_hardened", "faster_rcnn_hardened")
"""Reference detectors after `skyproof harden`, to set beside the plain ones."""

SHIPPED_DETECTORS = (*REFERENCE_DETECTORS, *HARDENED_DETECTORS)
"""All whose name serves as a detector folder."""

REFERENCE_FOLDER = Path(__file__).with_name("reference")

LEAST_AP = 0.2
"""Average precision (centre within 1 m) below which a detector is useless.

Untrained networks reach 0.04 to 0.12 on images crowded with vehicles (one to four on 12 x 12 m),
and random boxes 0.04 to 0.07. A detector that passes the precheck reaches 0.9.
"""

LEAST_VEHICLES = 50
"""Number of validation vehicles below which chance decides a threshold and its recall.

The 95 % interval of a recall of 90 % is 8 points either way for 50 vehicles, and 26 for 5.
"""

PARENT_FILE = "parent.json"
"""The file in a hardened detector's folder with the detector's results before hardening."""

_FORMAT = 1
_REMEDY = "copy the whole folder again, or train or import the detector again"

Digest = Annotated[str, Meta(max_length=64)]

_Side = Annotated[int, Meta(ge=0, le=16_384)]
_Word = Annotated[str, Meta(max_length=100)]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class DetectorCard(Checked):
    """The content of `detector.json`. A black-box detector needs name, threshold and resolution.

    Attributes:
        name: name in tables: one of `DETECTOR_NAMES` for ours, the given name for another detector.
        size: "slim" or "full" for ours, "brought" for an imported one; else empty.
        image_size_px: height and width of the first training image, at most those of a training
            window; those of the first validation image for an imported detector.
        validation: "ap_centre_1m", "ap_iou_50" and "f1" (centre), each 0 to 1.
        threshold_from: source of the threshold, if it was frozen anew.
        weights_sha256: digest of the weights; empty until stored, and for a black-box detector.
    """

    format: int = field(default=_FORMAT, kw_only=True)
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
    weights_sha256: Digest = field(default="", compare=False)

    @property
    def trainable(self) -> bool:
        """Whether skyproof can train the detector; not if only its detections are known."""
        return bool(self.size) and (self.brought is None or self.brought.trainable)

    @property
    def doubts(self) -> list[str]:
        """The reasons not to attack the detector at all, one sentence each; usually none."""
        name = detector_name(self.name)
        ap = self.validation.get("ap_centre_1m")
        found = []
        if ap is not None and ap < LEAST_AP:
            remedy = "check its boxes and the metres per pixel that it was made for"
            if self.threshold_from:
                remedy = "check the labels and the metres per pixel of the imagery"
            elif self.brought is not None:
                checked = "check that the checkpoint was trained, and check --vehicle-classes and"
                remedy = f"{checked} the metres per pixel that it was made for"
            elif self.size:
                remedy = "train it longer or on more images"
            found.append(
                f"{name} reaches a validation AP of {ap:.3f}, and below {LEAST_AP:g} no attack on "
                f"it means anything; {remedy}."
            )
        vehicles = self.validation_vehicles
        if vehicles is not None and vehicles < LEAST_VEHICLES:
            found.append(
                f"The threshold of {name} was chosen on {vehicles} vehicles, and with fewer than "
                f"{LEAST_VEHICLES} chance decides it; give validation images with more."
            )
        return found


def write_card(path: Path, card: DetectorCard) -> None:
    """Writes `detector.json`."""
    write_json(path, asdict(card))


def read_card(folder: Path) -> DetectorCard:
    """Reads the card of a detector folder, or of a detector that comes with skyproof."""
    place = detector_folder(folder)
    if place.is_file():
        raise StoredFileError(
            f"{place} is a file and no detector folder; make one of a checkpoint with "
            "skyproof import, and give that."
        )
    with reinstalled(place):
        path = place / "detector.json"
        card: DetectorCard = read_document(path, DetectorCard, _REMEDY, version=_FORMAT)
        if not card.weights_sha256 and (place / "weights.safetensors").exists():
            raise StoredFileError(
                f"{path} lacks the weights_sha256 of the weights beside it; {_REMEDY}."
            )
        return card


def require_detector_name(name: str, remedy: str) -> None:
    """Refuses a detector name that tables or files cannot use; `remedy` is the error's advice."""
    # "mean" is the average of all detectors in tables.
    if not _NAME.fullmatch(name) or not is_name(name) or name == "mean":
        raise ConfigurationError(
            f"{name[:200]!r} is no name for a detector: at most 150 letters, digits, . _ - are, "
            f"and mean is taken; {remedy}."
        )


def reference_folder(name: str) -> Path:
    """Returns the folder of a detector that ships with skyproof; refuses the name of another."""
    if name not in SHIPPED_DETECTORS:
        raise ConfigurationError(
            f"{name[:100]!r} does not come trained, only {listed(SHIPPED_DETECTORS)} do; train it "
            "(skyproof train), or name one of these."
        )
    return REFERENCE_FOLDER / name


def detector_folder(place: str | Path) -> Path:
    """Returns the folder or the checkpoint file that `place` stands for.

    A shipped detector's name stands for its folder, a folder of transformers for its weights.
    """
    folder = Path(place)
    if str(place) in SHIPPED_DETECTORS and not folder.exists():
        return REFERENCE_FOLDER / folder.name
    if (folder / "detector.json").exists():
        return folder
    return next((folder / name for name in FOLDER_WEIGHTS if (folder / name).is_file()), folder)


@contextmanager
def reinstalled(folder: Path) -> Iterator[None]:
    """Adds the advice to install skyproof again to errors about a detector that ships with it."""
    try:
        yield
    except StoredFileError as error:
        if folder.parent != REFERENCE_FOLDER:
            raise
        wrong = str(error).partition(";")[0].rstrip(".")
        raise StoredFileError(
            f"A detector that came with skyproof cannot be used: {wrong}; install skyproof again."
        ) from error
