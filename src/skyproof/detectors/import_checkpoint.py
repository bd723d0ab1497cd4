"""Turns a checkpoint into a detector folder: weights, vehicle classes, frozen threshold."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchvision.models import detection

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.card import DetectorCard, require_detector_name
from skyproof.detectors.checkpoints import network_of, read_checkpoint, state_of
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.imported_torchvision import count_classes
from skyproof.detectors.loaded import save_detector
from skyproof.detectors.stored_ultralytics import read_ultralytics
from skyproof.detectors.threshold import check_validation, frozen_card
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import file_digest, finished_folder, refuse_existing
from skyproof.ranges import GroundResolution, check_value

# Published weights whose batch norm was trained with no epsilon (torchvision's `overwrite_eps`).
_WITHOUT_EPS = {
    "retinanet_resnet50_fpn": detection.RetinaNet_ResNet50_FPN_Weights.COCO_V1,
    "fasterrcnn_resnet50_fpn": detection.FasterRCNN_ResNet50_FPN_Weights.COCO_V1,
}


# Architecture, names of classes, positions of the vehicle classes, epsilon of the batch norm.
_Plan = tuple[str | dict[str, Any], list[str], list[int], float | None]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint file, and the facts needed to read it.

    Attributes:
        path: `.pt` or `.pth` of `torch.save`, or `.safetensors`; no code in it runs.
        kind: "torchvision" or "ultralytics".
        vehicle_classes: names of the vehicle classes for Ultralytics, label numbers for torchvision
            (COCO: 3 car, 6 bus, 8 truck).
        architecture: torchvision's name of the architecture, such as "retinanet_resnet50_fpn".
        gsd_m: metres per pixel that the detector was made for; None is the resolution of the
            images.
    """

    path: Path
    kind: str
    vehicle_classes: Sequence[str]
    architecture: str | None = None
    gsd_m: float | None = None


def import_detector(
    checkpoint: Checkpoint,
    validation: Dataset,
    folder: str | Path,
    *,
    name: str | None = None,
    device: torch.device | str = "cpu",
) -> DetectorCard:
    """Converts a checkpoint to a detector folder that `load_detector` opens, and returns its card.

    Args:
        checkpoint: the checkpoint to import.
        validation: images that freeze the threshold, at the resolution of later use.
        folder: new folder for `weights.safetensors` and `detector.json`; must not exist yet.
        name: name in tables; the folder's name if None, because most files are called best.pt.
        device: device of the validation.

    Raises:
        ConfigurationError: the weights do not fit, a class does not exist, the validation images
            hold no vehicle or none is found, or ultralytics is not installed.
        StoredFileError: the file is no checkpoint, or holds another kind of network.
        RunFolderError: the folder exists, or the disk is full or not writable.
    """
    folder = Path(folder)
    refuse_existing(folder)
    name = folder.resolve().name if name is None else name
    require_detector_name(name, "choose another name, or folder")
    check_validation(validation)
    gsd_m = validation.gsd_m if checkpoint.gsd_m is None else checkpoint.gsd_m
    check_value("--gsd", gsd_m, GroundResolution)
    scale = validation.gsd_m / gsd_m
    if not 0.05 <= scale <= 20:
        raise ConfigurationError(
            f"--gsd {gsd_m:g} is out of reason for images of {validation.gsd_m:g} m per pixel; "
            "give what the detector was made for."
        )
    read = {"torchvision": _torchvision, "ultralytics": _ultralytics}.get(checkpoint.kind)
    if read is None:
        raise ConfigurationError(
            f"a checkpoint is of torchvision or of ultralytics, not of {checkpoint.kind!r}."
        )
    network = network_of(read_checkpoint(checkpoint.path))
    state = state_of(network)
    if not state:
        raise StoredFileError(
            f"{checkpoint.path} holds no weights; give a checkpoint with a network or a state dict."
        )
    broken = next((name for name, value in state.items() if not value.isfinite().all()), None)
    if broken is not None:
        raise StoredFileError(
            f"{checkpoint.path} holds weights that are not finite ({broken[:100]}); give a "
            "checkpoint from before its training broke."
        )
    digest = file_digest(checkpoint.path)
    architecture, classes, vehicles, eps = read(checkpoint, network, state, digest)
    blueprint = Blueprint(
        checkpoint.kind,
        architecture,
        classes,
        vehicles,
        scale,
        eps,
        checkpoint.path.name,
        digest,
    )
    try:
        detector = ImportedDetector(name, blueprint)
    except ConfigurationError as error:
        raise ConfigurationError(f"{checkpoint.path} cannot be imported: {error}") from error
    _load(detector, state, checkpoint)
    detector.eval().requires_grad_(False).to(device)
    remedy = (
        "check --vehicle-classes, and say which metres per pixel it was made for (--gsd; "
        "--detector-gsd of skyproof assess)"
    )
    width, height = validation.pictures[0].size_px
    card = replace(
        frozen_card(detector, validation, remedy),
        size=detector.size,
        image_size_px=(height, width),
        parameters=sum(parameter.numel() for parameter in detector.parameters()),
        trained_on=f"elsewhere: {checkpoint.kind} checkpoint {checkpoint.path.name}",
        brought=blueprint,
    )
    with finished_folder(folder) as partial:
        save_detector(partial, detector, card)
    return card


def _torchvision(
    checkpoint: Checkpoint, network: Any, state: dict[str, Tensor], digest: str
) -> _Plan:
    if checkpoint.architecture is None:
        raise ConfigurationError(
            "a torchvision checkpoint does not say what it is; give --architecture."
        )
    count = count_classes(checkpoint.architecture, state)
    # Faster R-CNN's class 0 is the background.
    first = 1 if checkpoint.architecture.startswith("fasterrcnn") else 0
    try:
        numbers = [int(word) for word in checkpoint.vehicle_classes]
    except ValueError:
        numbers = []
    if not numbers or not all(first <= number < count for number in numbers):
        raise ConfigurationError(
            f"--vehicle-classes expects label numbers from {first} to {count - 1} (torchvision "
            f"keeps no names), got {' '.join(checkpoint.vehicle_classes) or 'none'}."
        )
    published = _WITHOUT_EPS.get(checkpoint.architecture)
    # torchvision's file names end with the first digits of their digest.
    same = published is not None and published.url.endswith(f"-{digest[:8]}.pth")
    eps = 0.0 if same else None
    return checkpoint.architecture, [str(number) for number in range(count)], numbers, eps


def _ultralytics(
    checkpoint: Checkpoint, network: Any, state: dict[str, Tensor], digest: str
) -> _Plan:
    if checkpoint.architecture is not None:
        raise ConfigurationError(
            "an Ultralytics checkpoint holds its architecture; leave --architecture out."
        )
    return *read_ultralytics(checkpoint.path, network, state, checkpoint.vehicle_classes), None


def _load(detector: ImportedDetector, state: dict[str, Tensor], checkpoint: Checkpoint) -> None:
    model = detector.network.model
    wanted = model.state_dict()
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        different = sorted(
            name
            for name in {*wanted, *state}
            if not name.endswith("num_batches_tracked")
            and (name not in wanted or name not in state or wanted[name].shape != state[name].shape)
        )
        what = checkpoint.architecture or "the architecture it names"
        remedy = (
            "give the --architecture they were trained as"
            if checkpoint.architecture
            else "save it unfused"
        )
        raise ConfigurationError(
            f"The weights of {checkpoint.path} do not fit {what}: {len(different)} tensors differ, "
            f"such as {different[0] if different else 'none by name'}; {remedy}."
        ) from error
