"""Reads the plan of an Ultralytics network from the network that its checkpoint stores."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from skyproof.detectors.blueprint import plain_architecture
from skyproof.detectors.checkpoints import StandIn, parts_of
from skyproof.errors import ConfigurationError, StoredFileError

_NETWORKS = ("ultralytics.nn.tasks.DetectionModel", "ultralytics.nn.tasks.OBBModel")
# Modules of the repository of 2020, as a checkout and as a package.
_ANCHOR_NETWORKS = tuple(
    f"{package}models.yolo.{name}"
    for package in ("", "yolov5.")
    for name in ("Model", "DetectionModel")
)
_MOST_CLASSES = 5000


def read_ultralytics(
    path: Path, network: Any, state: dict[str, Tensor], vehicle_classes: Sequence[str]
) -> tuple[dict[str, Any], list[str], list[int]]:
    """Reads architecture, classes and vehicle classes of the network that `network_of` found.

    `state` loses the anchors of 2020, which become a part of the architecture. `path` is for
    messages.
    """
    origin = network.origin if isinstance(network, StandIn) else "a state dict"
    if origin not in (*_NETWORKS, *_ANCHOR_NETWORKS):
        raise StoredFileError(
            f"{path} holds {origin}, not a detection network of Ultralytics (YOLOv5, YOLOv8, "
            "YOLO11 or later); give a checkpoint that was trained to find boxes."
        )
    classes = _class_names(path, vars(network).get("names"))
    missing = [name for name in vehicle_classes if name not in classes]
    if missing or not vehicle_classes:
        raise ConfigurationError(
            f"--vehicle-classes expects names out of {', '.join(classes)}; got "
            f"{', '.join(missing) or 'none'}."
        )
    stored = vars(network).get("yaml")
    plain = {name: value for name, value in _items(stored) if name != "anchors"}
    try:
        if origin in _ANCHOR_NETWORKS:
            plain = _with_anchors(network, state, plain)
        else:
            plain = _with_pooling(network, plain)
        architecture = plain_architecture(plain)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path} cannot be imported: {error}") from error
    return architecture, classes, [classes.index(name) for name in vehicle_classes]


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
    """Completes the architecture of a YOLOv5 of 2020 with the anchors that it was trained with.

    They may differ from its YAML file, because its trainer replaces badly fitting anchors.
    """
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
    # That module holds attention, too.
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


def _items(stored: Any) -> list[tuple[Any, Any]]:
    return list(stored.items())[:100] if isinstance(stored, Mapping) else []
