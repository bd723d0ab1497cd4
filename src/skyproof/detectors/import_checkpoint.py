"""Turns a checkpoint into a detector folder: weights, vehicle classes, frozen threshold."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor
from torchvision.models import detection

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.blueprint import (
    FOLDER_FILES,
    FOLDER_WEIGHTS,
    Blueprint,
    Kind,
    plain_architecture,
)
from skyproof.detectors.card import DetectorCard, require_detector_name
from skyproof.detectors.checkpoints import (
    Checkpoint,
    ReadNetwork,
    StandIn,
    class_positions,
    networks_in,
    parts_of,
    read_checkpoint,
    state_of,
)
from skyproof.detectors.imported import ImportedDetector, class_rows
from skyproof.detectors.loaded import save_detector
from skyproof.detectors.transformers_detectors import converted_weights
from skyproof.detectors.transformers_files import is_rf_detr, read_folder, read_rf_detr
from skyproof.detectors.validation import check_validation, frozen_card, validate
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import file_digest, finished_folder, refuse_existing
from skyproof.ranges import GroundResolution, check_value
from skyproof.words import listed

# Published weights whose batch norm was trained with no epsilon (torchvision's `overwrite_eps`).
_WITHOUT_EPS = {
    "retinanet_resnet50_fpn": detection.RetinaNet_ResNet50_FPN_Weights.COCO_V1,
    "fasterrcnn_resnet50_fpn": detection.FasterRCNN_ResNet50_FPN_Weights.COCO_V1,
}

_KINDS = ("Detection", "OBB", "RTDETRDetection", "Segmentation")
_NETWORKS = [f"ultralytics.nn.tasks.{kind}Model" for kind in _KINDS]
# Modules of the repository of 2020, as a checkout and as a package.
_ANCHOR_NETWORKS = tuple(
    f"{package}models.yolo.{name}"
    for package in ("", "yolov5.")
    for name in ("Model", "DetectionModel")
)
_MOST_CLASSES = 5000


def kind_of(path: Path, architecture: str | None) -> Kind:
    """Returns the kind of a checkpoint file; only torchvision's needs an architecture."""
    if architecture is not None:
        return "torchvision"
    told = path.name in FOLDER_WEIGHTS and path.with_name("config.json").is_file()
    return "transformers" if told else "ultralytics"


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
    detector, blueprint, origin = read_network(checkpoint, scale, name)
    detector.eval().requires_grad_(False).to(device)
    if blueprint.normalised is None:
        blueprint = replace(blueprint, normalised=_sees_normalised(detector, validation))
        origin += f", colours {'' if blueprint.normalised else 'not '}normalised, as labels suggest"
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
        trained_on=f"elsewhere: {origin}",
        brought=blueprint,
    )
    with finished_folder(folder) as partial:
        save_detector(partial, detector, card)
    return card


def read_network(
    checkpoint: Checkpoint, scale: float, name: str
) -> tuple[ImportedDetector, Blueprint, str]:
    """Reads a checkpoint and loads its weights into its network; see `read_blueprint`."""
    blueprint, state, origin = read_blueprint(checkpoint, scale)
    try:
        detector = ImportedDetector(name, blueprint)
    except ConfigurationError as error:
        raise ConfigurationError(f"{checkpoint.path} cannot be imported: {error}") from error
    _load(detector, state, checkpoint)
    return detector, blueprint, origin


def read_blueprint(
    checkpoint: Checkpoint, scale: float
) -> tuple[Blueprint, dict[str, Tensor], str]:
    """Returns a checkpoint's blueprint and weights, and a text about which weights were taken.

    `scale` is the number of network pixels per image pixel.
    """
    kind: str = checkpoint.kind
    if kind not in get_args(Kind):
        raise ConfigurationError(
            f"a checkpoint is of {', '.join(get_args(Kind))}, not of {checkpoint.kind!r}."
        )
    if kind != "torchvision" and checkpoint.architecture is not None:
        raise ConfigurationError(
            f"a checkpoint of {kind} holds its architecture; leave --architecture out."
        )
    content = read_checkpoint(checkpoint.path)
    places = networks_in(content)
    network = next(iter(places.values()), content)
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
    in_folder = kind == "transformers" and checkpoint.path.with_name(FOLDER_FILES[0]).is_file()
    # `assess` asks for no kind, and the weights tell this one.
    if kind != "torchvision" and is_rf_detr(state):
        kind = "transformers"
    digest = file_digest(checkpoint.path)
    tensors = len(state)
    if kind == "torchvision":
        read = _torchvision(checkpoint, state, digest)
    elif kind == "ultralytics":
        read = read_ultralytics(checkpoint, network, state, digest)
    elif is_rf_detr(state) and not in_folder:
        read = read_rf_detr(checkpoint, content, state)
    else:
        read = read_folder(checkpoint)
    if kind == "transformers":
        source = "its config.json" if in_folder else "the settings in it"
        weights = converted_weights(read, state, checkpoint.path, source)
        state.clear()
        state.update(weights)
    side_px = read.side_px or _noted(content, "train_args").get("imgsz")
    known = type(side_px) is int and 32 <= side_px <= 4096
    # torchgeo stopped normalising in its release 0.8, and checkpoints do not note the release.
    of_torchgeo = {"backbone", "freeze_backbone"} <= _noted(content, "hyper_parameters").keys()
    named = checkpoint.path.parent if in_folder else checkpoint.path
    blueprint = Blueprint(
        kind=kind,
        architecture=read.architecture,
        classes=read.classes,
        vehicle_classes=read.vehicle_classes,
        image_scale=scale,
        norm_eps=read.norm_eps,
        checkpoint=named.name,
        checkpoint_sha256=digest,
        side_px=side_px if known else None,
        normalised=None if of_torchgeo else True,
    )
    origin = f"{kind} checkpoint {named.name}"
    taken, *others = [repr(place[:100]) for place in places] or [""]
    if others:
        origin += f", the weights at {taken}, not those at {listed(others[:3])}"
    # The anchors of an Ultralytics network have left `state`, too, but they are used.
    if checkpoint.kind == "torchvision" and len(state) < tensors:
        origin += f", without {tensors - len(state)} tensors beside the network"
    return blueprint, state, origin


def _noted(content: Any, name: str) -> Mapping[str, Any]:
    noted = content.get(name) if isinstance(content, Mapping) else None
    return noted if isinstance(noted, Mapping) else {}


def _sees_normalised(detector: ImportedDetector, validation: Dataset) -> bool:
    """Says whether normalised colours give the higher AP, and sets the network accordingly."""
    network: Any = detector.network
    network.normalised = False
    without = validate(detector, validation)["ap_centre_1m"]
    network.normalised = True
    network.normalised = validate(detector, validation)["ap_centre_1m"] >= without
    return bool(network.normalised)


def _torchvision(checkpoint: Checkpoint, state: dict[str, Tensor], digest: str) -> ReadNetwork:
    if checkpoint.architecture is None:
        raise ConfigurationError(
            "a torchvision checkpoint does not say what it is; give --architecture."
        )
    count, prefix = class_rows(checkpoint.architecture, state)
    own = {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}
    masks = "roi_heads.mask_" if checkpoint.architecture.startswith("maskrcnn") else ()
    own = {name: tensor for name, tensor in own.items() if not name.startswith(masks)}
    state.clear()
    state.update(own)
    # Faster R-CNN's class 0 is the background.
    first = 1 if checkpoint.architecture.startswith(("fasterrcnn", "maskrcnn")) else 0
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
    classes = [*map(str, range(count))]
    return ReadNetwork(checkpoint.architecture, classes, numbers, 0.0 if same else None)


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
        given = checkpoint.architecture
        what = given or "the architecture it names"
        remedy = "give the --architecture they were trained as" if given else "save it unfused"
        raise ConfigurationError(
            f"The weights of {checkpoint.path} do not fit {what}: {len(different)} tensors differ, "
            f"such as {different[0] if different else 'none by name'}; {remedy}."
        ) from error


def read_ultralytics(
    checkpoint: Checkpoint, network: Any, state: dict[str, Tensor], digest: str
) -> ReadNetwork:
    """Reads a stored network's plan; anchors of 2020 move from `state` to the architecture."""
    path = checkpoint.path
    origin = network.origin if isinstance(network, StandIn) else "a state dict"
    if origin not in (*_NETWORKS, *_ANCHOR_NETWORKS):
        raise StoredFileError(
            f"{path} holds {origin}, not a detection network of Ultralytics (YOLOv5, YOLOv8, "
            "YOLO11 or later). Export another one that finds boxes to ONNX, which skyproof assess "
            "tests as a black box, or give sp.assess a function that finds them (examples/recipes)."
        )
    classes = _class_names(path, vars(network).get("names"))
    vehicles = class_positions(checkpoint.vehicle_classes, classes)
    stored = vars(network).get("yaml")
    items = list(stored.items())[:100] if isinstance(stored, Mapping) else []
    plain = {name: value for name, value in items if name != "anchors"}
    try:
        if origin in _ANCHOR_NETWORKS:
            plain = _with_anchors(network, state, plain)
        else:
            plain = _with_pooling(network, plain)
        architecture = plain_architecture(plain)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path} cannot be imported: {error}") from error
    return ReadNetwork(architecture, classes, vehicles)


def _class_names(path: Path, names: Any) -> list[str]:
    listed = dict(enumerate(names)) if isinstance(names, list | tuple) else names
    found: list[Any] = []
    if isinstance(listed, dict) and len(listed) <= _MOST_CLASSES:
        found = [listed.get(index) for index in range(len(listed))]
    classes = [name for name in found if isinstance(name, str)]
    if not classes or len(classes) < len(found):
        raise StoredFileError(
            f"{path} holds no class names; give a checkpoint as Ultralytics saves it."
        )
    return classes


def _with_anchors(
    network: StandIn, state: dict[str, Tensor], stored: Mapping[str, Any]
) -> dict[str, Any]:
    """Adds the anchors that a YOLOv5 of 2020 was trained with, which may differ from its YAML's."""
    cells = next((state.pop(name) for name in list(state) if name.endswith(".anchors")), None)
    # Up to release 5.0, checkpoints store them a second time, in pixels.
    for name in [name for name in state if name.endswith(".anchor_grid")]:
        del state[name]
    strides = vars(network).get("stride")
    head = stored.get("head")
    *rows, last = head if isinstance(head, list | tuple) and head else [None]
    if (
        cells is None
        or cells.ndim != 3
        or not isinstance(strides, Tensor)
        or strides.shape != cells.shape[:1]
        or not isinstance(last, list | tuple)
        or len(last) != 4
    ):
        raise ConfigurationError(
            "its network holds no anchors, or no strides for them; give a checkpoint as YOLOv5 "
            "saves it."
        )
    wanted = re.search(r"nn\.(\w+)", str(stored.get("activation") or "nn.SiLU"))
    before = "torch.nn.modules.activation."
    origins = {part.origin for part, _ in parts_of(network) if part.origin.startswith(before)}
    # PyTorch defines its attention layer in the same module.
    found = {origin.removeprefix(before) for origin in origins} - {"MultiheadAttention"}
    if wanted is None or found - {wanted[1]}:
        raise ConfigurationError(
            f"its layers compute {', '.join(sorted(found))}, as those of releases before 4.0 "
            "(January 2021) do, but SiLU is expected; train it with a later release."
        )
    pixels = (cells.double() * strides.double().view(-1, 1, 1)).flatten(1).tolist()
    # The head's arguments were the number of classes and the anchors.
    return {**stored, "head": [*rows, [*last[:3], ["nc"]]], "anchors": pixels}


def _with_pooling(network: StandIn, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Notes in the rows of pooling layers (SPPF) whether their first convolution is activated.

    Ultralytics 8.4.0 dropped the activation for YOLO26, whose rows give the number of poolings: at
    first for all networks, later only for such rows. Only the stored network tells.
    """
    bare = {
        prefix.split(".")[1]
        for part, prefix in parts_of(network)
        if prefix.endswith(".cv1.act.") and part.origin == "torch.nn.modules.linear.Identity"
    }
    told = dict(stored)
    number = 0
    for section in ("backbone", "head"):
        rows = stored.get(section)
        if not isinstance(rows, list | tuple):
            continue
        told[section] = []
        for row in rows:
            if isinstance(row, list | tuple) and len(row) == 4 and row[2] == "SPPF":
                source, count, name, given = row
                # Channels and side of the window; three poolings are usual.
                if isinstance(given, list | tuple) and len(given) < 3 and str(number) in bare:
                    row = [source, count, name, [*given, *[5, 3][len(given) - 1 :]]]
            told[section].append(row)
            number += 1
    return told
