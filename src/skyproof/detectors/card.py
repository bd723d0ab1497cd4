"""What a detector folder says of itself in `detector.json`. Imports no torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_json

__all__ = [
    "FOLDER_FORMAT",
    "DetectorCard",
    "installed_version",
    "read_card",
    "read_card_and_digest",
    "write_card",
]

FOLDER_FORMAT = 1


@dataclass(frozen=True)
class DetectorCard:
    """What is known of a detector. A black box needs a name, a threshold and a resolution.

    Attributes:
        name: as tables show it: "retinanet", "faster_rcnn" or "yolov5" of ours; of another
            detector the name it was given.
        size: "slim" or "full" of ours, "brought" of an imported one, empty of a black box.
        threshold: frozen score threshold, chosen for the largest F1 on clean validation images.
        gsd_m: metres per pixel of the images it takes.
        image_size_px: height and width of the first training image, at most those of a training
            window; of an imported detector, of the first validation image.
        parameters: number of trained numbers.
        training: settings and what was reached, as written by `train`; empty of an imported one.
        validation: "ap_centre_1m", "ap_iou_50" and "f1" (centre), each 0 to 1.
        skyproof_version: that wrote it.
        trained_on: what its training images were, in a few words; empty where not known.
        brought: of an imported detector what builds its network (`imported.Blueprint`); else None.
    """

    name: str
    size: str = ""
    threshold: float = field(kw_only=True)
    gsd_m: float = field(kw_only=True)
    image_size_px: tuple[int, int] = (0, 0)
    parameters: int = 0
    training: dict[str, Any] = field(default_factory=dict)
    validation: dict[str, float] = field(default_factory=dict)
    skyproof_version: str = ""
    trained_on: str = ""
    brought: dict[str, Any] | None = None


def write_card(path: Path, card: DetectorCard, weights_sha256: str) -> None:
    """Writes `detector.json` with the digest of the weights that it belongs to.

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    record = {"format": FOLDER_FORMAT, **asdict(card), "weights_sha256": weights_sha256}
    write_json(path, record)


def read_card(folder: Path) -> DetectorCard:
    """Reads the card of a detector folder.

    Raises:
        StoredFileError: `detector.json` is missing, damaged, or of another format.
    """
    return read_card_and_digest(Path(folder) / "detector.json")[0]


def read_card_and_digest(path: Path) -> tuple[DetectorCard, str]:
    """Reads `detector.json` with the digest of the weights that it belongs to.

    Raises:
        StoredFileError: the file is missing, damaged, or of another format.
    """
    record = read_json(path)
    stored_format = record.get("format") if isinstance(record, dict) else None
    if stored_format != FOLDER_FORMAT:
        raise StoredFileError(
            f"{path} has format {stored_format!r}, but this version of skyproof reads format "
            f"{FOLDER_FORMAT}; train the detector again or use the version that wrote it."
        )
    try:
        # Folders of before these fields were there stay readable.
        record = {"trained_on": "", "brought": None, **record}
        fields = {key: record[key] for key in DetectorCard.__dataclass_fields__}
        fields["image_size_px"] = (int(fields["image_size_px"][0]), int(fields["image_size_px"][1]))
        fields["threshold"] = float(fields["threshold"])
        fields["gsd_m"] = float(fields["gsd_m"])
        return DetectorCard(**fields), str(record["weights_sha256"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise StoredFileError(
            f"{path} lacks or garbles the field {error}; train the detector again."
        ) from error


def installed_version() -> str:
    """skyproof's version, or "unknown" when it runs from sources that were not installed."""
    try:
        return version("skyproof")
    except PackageNotFoundError:
        return "unknown"
