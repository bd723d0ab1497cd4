"""The plan of an imported detector's network, without its weights. Imports no torch.

A blueprint comes from folders and checkpoints of strangers, so it may name plain layers only, and
every number in it is bounded. `ultralytics_detectors` measures a network before building it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from skyproof.documents import check_document, in_words
from skyproof.errors import ConfigurationError
from skyproof.ranges import check_ranges

_BY_BACKBONE = [
    f"{family}_{backbone}_fpn"
    for family in ("fasterrcnn", "maskrcnn", "retinanet")
    for backbone in ("resnet18", "resnet34", "resnet50", "resnet101", "resnet152")
]
ARCHITECTURES = (
    "fasterrcnn_mobilenet_v3_large_320_fpn",
    "fasterrcnn_mobilenet_v3_large_fpn",
    "fasterrcnn_resnet50_fpn_v2",
    "fcos_resnet50_fpn",
    "maskrcnn_resnet50_fpn_v2",
    "retinanet_resnet50_fpn_v2",
    *_BY_BACKBONE,
)
# The heads of Ultralytics that skyproof can read (without masks), those with oriented boxes, and
# that of RT-DETR.
TURNED = ("OBB", "OBB26")
QUERIES = "RTDETRDecoder"
HEADS = ("Detect", "v10Detect", "Segment", "Segment26", *TURNED, QUERIES)
# Ultralytics looks a layer's name up among all it imports, functions that open files included, and
# evaluates the text of an activation: only names of plain layers pass.
_LAYER_NAMES = """
A2C2f AConv ADown AIFI Bottleneck BottleneckCSP C1 C2 C2PSA C2f C2fCIB C2fPSA C3 C3Ghost C3TR C3k2
C3x CBFuse CBLinear Concat Conv ConvTranspose DWConv DWConvTranspose2d ELAN1 Focus GhostBottleneck
GhostConv HGBlock HGStem PSA RepC3 RepNCSPELAN4 ResNetLayer SCDown SPP SPPELAN SPPF nn.AvgPool2d
nn.BatchNorm2d nn.Conv2d nn.ConvTranspose2d nn.Identity nn.MaxPool2d nn.Upsample nn.ZeroPad2d
"""
_LAYERS = frozenset(_LAYER_NAMES.split())
_ACTIVATION = re.compile(r"(torch\.)?nn\.[A-Z]\w*\((\w+=[\w.]+|[0-9.]+)?\)")

FOLDER_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
FOLDER_FILES = ("config.json", "preprocessor_config.json")
"""Files that may hold a folder's weights, and those that say what the network is and sees."""

# Families of transformers whose networks answer alike, and the backbones that they stand on.
TIMM = "timm_backbone"
_BACKBONES = ("rt_detr_resnet", "resnet", "hgnet_v2")
_FAMILIES = {
    # They would ask the hub for a backbone of timm.
    **dict.fromkeys(("rt_detr", "rt_detr_v2", "d_fine"), _BACKBONES),
    "deimv2": ("hgnet_v2", "dinov3_vit"),
    **dict.fromkeys(("detr", "conditional_detr", "deformable_detr"), (*_BACKBONES, TIMM)),
    "lw_detr": ("lw_detr_vit",),
    "rf_detr": ("rf_detr_dinov2",),
}
_RESNET = re.compile(r"resnet\d{2,3}d?(\.\w{1,30})?")

# More than LVIS has: RetinaNet scores each class for 200,000 anchors in an image of 1024 px.
_MOST_TORCHVISION_CLASSES = 1500

Kind = Literal["torchvision", "ultralytics", "transformers"]
"""The library whose network a checkpoint holds."""

Classes = Annotated[list[Annotated[str, Meta(max_length=200)]], Meta(max_length=5000)]

_Whole = Annotated[int, Meta(ge=-8192, le=8192)]
_Real = Annotated[float, Meta(ge=-8192, le=8192)]
# Ultralytics reads a text that is not a name as a number or a list. `_check_words` refuses those: a
# `pattern` in such nested types makes msgspec 0.22 crash when the program ends (its issue 717).
_Word = Annotated[str, Meta(max_length=100)]
_NAME = re.compile(r"[A-Za-z][\w.()=]*")
_Plain = bool | _Whole | _Real | _Word | None
_Few = Annotated[list[_Plain], Meta(max_length=100)]
_Argument = bool | _Whole | _Real | _Word | _Few | None
_Sources = _Whole | Annotated[list[_Whole], Meta(max_length=100)]
_Row = tuple[
    _Sources,
    Annotated[int, Meta(ge=1, le=100)],
    Annotated[str, Meta(max_length=100)],
    Annotated[list[_Argument], Meta(max_length=20)],
]
_Rows = Annotated[list[_Row], Meta(max_length=200)]
_Scale = Annotated[float, Meta(gt=0, le=16)]
_Limit = Annotated[float, Meta(gt=0, le=65_536)]
_Anchors = Annotated[list[_Limit], Meta(min_length=2, max_length=20)]


class _Architecture(msgspec.Struct):
    """The fields of an Ultralytics architecture that are checked."""

    backbone: _Rows
    head: Annotated[_Rows, Meta(min_length=1)]
    activation: Annotated[str, Meta(max_length=100)] | None = None
    channels: int = 3
    depth_multiple: _Scale = 1.0
    width_multiple: _Scale = 1.0
    reg_max: Annotated[int, Meta(ge=1, le=64)] = 16
    nc: Annotated[int, Meta(ge=1, le=5000)] = 80
    scales: Annotated[dict[str, tuple[_Scale, _Scale, _Limit]], Meta(max_length=100)] | None = None
    kpt_shape: _Few | None = None
    # Only in the YOLOv5 of 2020: width, height, width, height, ... per level, pixels.
    anchors: Annotated[list[_Anchors], Meta(min_length=1, max_length=5)] | None = None


_Number = Annotated[float, Meta(ge=-65_536, le=65_536)]
_Setting = bool | Annotated[int, Meta(ge=-65_536, le=65_536)] | _Number | _Word | None
_Settings = Annotated[
    dict[_Word, _Setting | Annotated[list[_Setting], Meta(max_length=100)]], Meta(max_length=300)
]
_Mean = Annotated[list[_Number], Meta(min_length=3, max_length=3)]
_Deviation = Annotated[list[_Scale], Meta(min_length=3, max_length=3)]


class _Configuration(msgspec.Struct, forbid_unknown_fields=True):
    """A network of transformers: fields of its config.json, and how colours are normalised."""

    network: _Settings
    backbone: _Settings
    image_mean: _Mean
    image_std: _Deviation


@dataclass(frozen=True)
class Blueprint:
    """The plan of an imported detector's network, without its weights; kept in `detector.json`.

    The architecture is a name for torchvision, whose classes are "0", "1", ..., the content of a
    YAML file for Ultralytics, and the parts of `_Configuration` for transformers. Vehicle classes
    are positions. `image_scale` is network pixels per image pixel, `norm_eps` the epsilon of the
    backbone's batch norm, if torchvision's published weights use another one than its layers.
    `side_px` is the side of the training images in network pixels, if the checkpoint notes it.
    `normalised` says whether the network expects colours normalised as by torchvision; None if that
    is not known.
    """

    kind: str
    architecture: str | dict[str, Any]
    classes: Classes
    vehicle_classes: Annotated[
        list[Annotated[int, Meta(ge=0, le=5000)]], Meta(min_length=1, max_length=5000)
    ]
    image_scale: Annotated[float, Meta(ge=0.05, le=20)]
    norm_eps: Annotated[float, Meta(ge=0, le=1)] | None
    checkpoint: Annotated[str, Meta(max_length=1000)]
    checkpoint_sha256: Annotated[str, Meta(max_length=64)]
    side_px: Annotated[int, Meta(ge=32, le=4096)] | None = None
    normalised: bool | None = True

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.kind == "ultralytics":
            check_layers(self.architecture)
        elif self.kind == "transformers":
            check_configuration(self.architecture)
        elif self.kind != "torchvision" or self.architecture not in ARCHITECTURES:
            raise ConfigurationError(
                f"no detector of kind {self.kind[:100]!r} is called "
                f"{str(self.architecture)[:100]!r}."
            )
        elif len(self.classes) > _MOST_TORCHVISION_CLASSES:
            raise ConfigurationError(
                f"a network of torchvision with {len(self.classes):,} classes computes too much, "
                f"at most {_MOST_TORCHVISION_CLASSES:,} are expected."
            )
        if max(self.vehicle_classes) >= len(self.classes):
            raise ConfigurationError(
                f"the vehicle class {max(self.vehicle_classes)} is not among {len(self.classes)}."
            )

    @property
    def trainable(self) -> bool:
        """Whether skyproof can train the network; not with oriented boxes or anchors."""
        plan: Any = self.architecture
        if self.kind != "ultralytics":
            return True
        return not ("anchors" in plan or plan["head"][-1][2] in TURNED)


def check_layers(architecture: Any) -> None:
    """Refuses an Ultralytics architecture unless it is plain layers and a detection head."""
    try:
        read = msgspec.convert(architecture, _Architecture)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ConfigurationError(
            "expected an Ultralytics architecture with rows of backbone and head "
            f"({in_words(str(error)).removeprefix(', ')[:200]}); give the network of a detector."
        ) from error
    _check_words([read.backbone, read.head, read.kpt_shape])
    *names, head = [name for _, _, name, _ in (*read.backbone, *read.head)]
    unknown = next((name for name in names if name not in _LAYERS), None)
    if unknown is not None:
        raise ConfigurationError(
            f"the network has a layer {unknown!r}, which is not one of Ultralytics' plain layers; "
            "give a detector of such."
        )
    if head not in HEADS:
        raise ConfigurationError(
            f"the network ends in {head!r}, not in one of {', '.join(HEADS)}; give one that "
            "finds boxes."
        )
    if read.anchors is not None:
        _check_anchors(read, read.anchors)
    if read.activation is not None and not _ACTIVATION.fullmatch(read.activation):
        raise ConfigurationError(
            f"the network's activation {read.activation!r} is not that of a plain layer; give "
            "a detector of such."
        )
    if read.channels != 3:
        raise ConfigurationError(
            f"the network takes images of {read.channels} channels; red, green and blue are "
            "expected."
        )


def check_configuration(architecture: Any) -> None:
    """Refuses a configuration of transformers unless its family is known and its fields plain."""
    what, remedy = "the configuration of transformers", "give the folder of a detector"
    read: Any = check_document(architecture, _Configuration, what, remedy, error=ConfigurationError)
    family, backbone = (part.get("model_type") for part in (read.network, read.backbone))
    known = _FAMILIES.get(str(family), ())
    if backbone not in known:
        raise ConfigurationError(
            f"the network is a {family} on a {backbone}, expected one of {', '.join(_FAMILIES)} on "
            f"one of {', '.join(known or _BACKBONES)}; export it to ONNX, which skyproof assess "
            "tests as a black box."
        )
    # timm would load other names from its hub.
    name = read.backbone.get("backbone")
    if backbone == TIMM and not (isinstance(name, str) and _RESNET.fullmatch(name)):
        raise ConfigurationError(
            f"the network's backbone is {str(name)[:100]!r} of timm, expected a ResNet; export it "
            "to ONNX, which skyproof assess tests as a black box."
        )


def _check_words(nested: Any) -> None:
    """Refuses texts that are no names among numbers and lists."""
    if isinstance(nested, list | tuple):
        for part in nested:
            _check_words(part)
    elif isinstance(nested, str) and not _NAME.fullmatch(nested):
        raise ConfigurationError(
            "expected an Ultralytics architecture with rows of backbone and head, got the text "
            f"{nested[:100]!r} in one; give the network of a detector."
        )


def _check_anchors(read: _Architecture, anchors: list[list[float]]) -> None:
    """Refuses anchors that are no pairs, or that differ in number between levels."""
    sources, _, head, _ = read.head[-1]
    levels = len(sources) if isinstance(sources, list) else 1
    if head != "Detect" or len(anchors) != levels or len({len(row) for row in anchors}) > 1:
        raise ConfigurationError(
            f"expected as many anchors for each of {levels} levels and a head Detect, got "
            f"{len(anchors)} levels of {', '.join(str(len(row)) for row in anchors)} numbers and "
            f"{head}; give a checkpoint as YOLOv5 saves it."
        )
    if len(anchors[0]) % 2:
        raise ConfigurationError(
            f"anchors are pairs of width and height, got {len(anchors[0])} numbers for a level; "
            "give a checkpoint as YOLOv5 saves it."
        )


def plain_architecture(stored: Any) -> dict[str, Any]:
    """Copies the checkable part of a stranger's architecture: known fields and plain values."""
    if not isinstance(stored, Mapping):
        raise ConfigurationError(
            "expected an Ultralytics architecture, got none; give a checkpoint as Ultralytics "
            "saves it."
        )
    check_layers(stored)
    known = _Architecture.__struct_fields__
    return {
        name: msgspec.to_builtins(value)
        for name, value in list(stored.items())[:100]
        if isinstance(name, str)
        and name != "yaml_file"
        and (name in known or value is None or isinstance(value, bool | int | float | str))
    }
