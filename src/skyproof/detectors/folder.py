"""A detector as a folder: `weights.safetensors` and `detector.json` (no pickle)."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from skyproof.detectors.detector import TrainableDetector
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import read_json, write_json
from skyproof.storage import read_tensors, write_tensors

__all__ = [
    "FOLDER_FORMAT",
    "DetectorCard",
    "build_detector",
    "load_detector",
    "read_card",
    "save_detector",
    "weights_digest",
]

FOLDER_FORMAT = 1
DETECTOR_NAMES = ("retinanet", "faster_rcnn", "yolov5")


@dataclass(frozen=True)
class DetectorCard:
    """What `detector.json` says.

    Attributes:
        name: "retinanet", "faster_rcnn" or "yolov5"; of a brought-in detector the name it was given.
        size: "slim" or "full"; "brought" of a brought-in detector.
        threshold: frozen score threshold, largest F1 on clean validation images (PAPER 18).
        gsd_m: metres per pixel of the images it takes.
        image_size_px: height and width of the first training image, at most those of a training window; of a
            brought-in detector, of the first validation image.
        parameters: number of trained numbers.
        training: settings and what was reached, as written by `train`; empty of a brought-in detector.
        validation: "ap_centre_1m", "ap_iou_50" and "f1" (centre), each 0 to 1.
        skyproof_version: that wrote it.
        trained_on: what its training images were, in a few words; empty where not known.
        brought: of a brought-in detector what builds its network (`brought.Blueprint`); None of ours.
    """

    name: str
    size: str
    threshold: float
    gsd_m: float
    image_size_px: tuple[int, int]
    parameters: int
    training: dict[str, Any]
    validation: dict[str, float]
    skyproof_version: str
    trained_on: str = ""
    brought: dict[str, Any] | None = None


def build_detector(name: str, size: str, *, generator: torch.Generator) -> TrainableDetector:
    """An untrained detector on the CPU; its first weights depend on `generator` alone.

    Args:
        name: "retinanet", "faster_rcnn" or "yolov5".
        size: "slim" (about 1 to 2.5 M parameters, for a CPU) or "full" (9 to 43 M, for a GPU).
        generator: one number is drawn from it.

    Raises:
        ConfigurationError: another name or size, or the yolo extra is missing.
    """
    seed = int(torch.randint(2**62, (1,), generator=generator))
    # The libraries draw initial weights from torch's global generator: lend it a seed and give its state back.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return _build(name, size)


def _build(name: str, size: str) -> TrainableDetector:
    # Imported here, so that matching and average precision do not pay for the networks.
    if name == "yolov5":
        from skyproof.detectors.ultralytics_detectors import YoloV5Detector

        return YoloV5Detector(size)
    if name not in DETECTOR_NAMES:
        raise ConfigurationError(f"A detector is one of {', '.join(DETECTOR_NAMES)}, not {name!r}.")
    from skyproof.detectors.torchvision_detectors import FasterRcnnDetector, RetinaNetDetector

    return RetinaNetDetector(size) if name == "retinanet" else FasterRcnnDetector(size)


def weights_digest(detector: nn.Module) -> str:
    """SHA-256 over names, shapes and bytes of parameters and buffers: equal before and after an attack (PAPER 23)."""
    digest = hashlib.sha256()
    for name, tensor in sorted(detector.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(
            tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        )
    return digest.hexdigest()


def plain_state(detector: nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers, detached copies on the CPU in plain layout, as safetensors wants them."""
    return {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in detector.state_dict().items()
    }


def save_detector(folder: Path, detector: TrainableDetector, card: DetectorCard) -> None:
    """Writes the folder; `detector.json` comes last, so a folder that has it is whole.

    Raises:
        RunFolderError: the disk is full or not writable.
    """
    folder = Path(folder)
    write_tensors(folder / "weights.safetensors", plain_state(detector))
    # The digest ties both files together: a weights file from elsewhere is noticed.
    record = {"format": FOLDER_FORMAT, **asdict(card), "weights_sha256": weights_digest(detector)}
    write_json(folder / "detector.json", record)


def read_card(folder: Path) -> DetectorCard:
    """Reads `detector.json`.

    Raises:
        StoredFileError: missing, damaged, or of another format.
    """
    return _card(Path(folder) / "detector.json")[0]


def load_detector(folder: str | Path) -> tuple[TrainableDetector, DetectorCard]:
    """Builds the detector a folder describes and loads its weights strictly; in eval mode, on the CPU.

    Raises:
        StoredFileError: a file is missing, damaged, of another format, or the tensors do not fit.
        ConfigurationError: the folder holds a YOLOv5 and the yolo extra is missing.
    """
    folder = Path(folder)
    card, stored_digest = _card(folder / "detector.json")
    path = folder / "weights.safetensors"
    tensors, _ = read_tensors(path, "train the detector again or copy the whole folder")
    try:
        detector = _of_card(card)
    except ConfigurationError as error:
        if card.brought is None and card.name in DETECTOR_NAMES and card.size in ("slim", "full"):
            raise
        raise StoredFileError(
            f"{folder / 'detector.json'} names an unknown detector: {error}"
        ) from error
    try:
        # BatchNorm fills in a missing counter silently, even when loaded strictly.
        if tensors.keys() != detector.state_dict().keys():
            raise RuntimeError("other tensor names")
        detector.load_state_dict(tensors)
    except RuntimeError as error:
        raise StoredFileError(
            f"{path} does not fit a {card.size} {card.name} of this version; train the detector, or bring it in, again."
        ) from error
    if weights_digest(detector) != stored_digest:
        raise StoredFileError(
            f"{path} is not the file that detector.json was written for; copy the whole folder again."
        )
    return detector.eval(), card


def _of_card(card: DetectorCard) -> TrainableDetector:
    if card.brought is None:
        return build_detector(card.name, card.size, generator=torch.Generator())
    from skyproof.detectors.brought import Blueprint, BroughtDetector

    try:
        blueprint = Blueprint(**card.brought)
    except (TypeError, ConfigurationError) as error:
        raise StoredFileError(f"detector.json garbles how {card.name} is built: {error}") from error
    return BroughtDetector(card.name, blueprint)


def installed_version() -> str:
    """skyproof's version, or "unknown" when it runs from sources that were not installed."""
    try:
        return version("skyproof")
    except PackageNotFoundError:
        return "unknown"


def _card(path: Path) -> tuple[DetectorCard, str]:
    record = read_json(path)
    found = record.get("format") if isinstance(record, dict) else None
    if found != FOLDER_FORMAT:
        raise StoredFileError(
            f"{path} has format {found!r}, but this version of skyproof reads format {FOLDER_FORMAT}; "
            "train the detector again or use the version that wrote it."
        )
    try:
        # Folders of before these fields were there stay readable.
        record = {"trained_on": "", "brought": None, **record}
        fields = {key: record[key] for key in DetectorCard.__dataclass_fields__}
        fields["image_size_px"] = (int(fields["image_size_px"][0]), int(fields["image_size_px"][1]))
        fields["threshold"], fields["gsd_m"] = float(fields["threshold"]), float(fields["gsd_m"])
        return DetectorCard(**fields), str(record["weights_sha256"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise StoredFileError(
            f"{path} lacks or garbles the field {error}; train the detector again."
        ) from error
