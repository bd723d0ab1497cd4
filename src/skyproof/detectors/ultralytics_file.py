"""Reads a checkpoint of Ultralytics as data: the plan of its network and its weights' names."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from skyproof.detectors.blueprint import plain_architecture
from skyproof.detectors.checkpoints import (
    Checkpoint,
    ReadNetwork,
    StandIn,
    class_positions,
    parts_of,
)
from skyproof.errors import ConfigurationError, StoredFileError

_KINDS = ("Detection", "OBB", "RTDETRDetection", "Segmentation")
_NETWORKS = [f"ultralytics.nn.tasks.{kind}Model" for kind in _KINDS]
# Modules of the repository of 2020, as a checkout and as a package.
_ANCHOR_NETWORKS = tuple(
    f"{package}models.yolo.{name}"
    for package in ("", "yolov5.")
    for name in ("Model", "DetectionModel")
)
_MOST_CLASSES = 5000


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
