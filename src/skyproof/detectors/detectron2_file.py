"""Reads a RetinaNet or Faster R-CNN of Detectron2 on a ResNet pyramid as one of torchvision.

The networks differ in the names of tensors, the order of colours and classes, anchors, and the
samples of a region. `config.yaml`, which the trainer writes beside its weights, tells the rest.
"""

import re
from collections.abc import Mapping
from typing import Any, Literal

import torch
import yaml
from msgspec import Struct, to_builtins
from torch import Tensor, nn
from torchvision import ops
from torchvision.models import detection
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.ops.feature_pyramid_network import LastLevelP6P7

from skyproof.detectors.blueprint import DETECTRON2_REMEDY, Detectron2Plan, detectron2_plan
from skyproof.detectors.checkpoints import Checkpoint, ReadNetwork, class_positions
from skyproof.detectors.region_align import area_levels
from skyproof.documents import check_document
from skyproof.errors import ConfigurationError, StoredFileError

_MARKS = ("backbone.bottom_up.stem.conv1.weight", "backbone.fpn_lateral5.weight")
_FIRST = "backbone.body.conv1.weight"
# Tensor names in Detectron2 and in torchvision, replaced one after the other.
_NAMES = (
    (r"^backbone\.bottom_up\.stem\.conv1\.norm\.", "backbone.body.bn1."),
    (r"^backbone\.bottom_up\.stem\.", "backbone.body."),
    (r"^backbone\.bottom_up\.res(\d)\.", lambda found: f"backbone.body.layer{int(found[1]) - 1}."),
    (r"\.shortcut\.norm\.", ".downsample.1."),
    (r"\.shortcut\.", ".downsample.0."),
    (r"\.conv(\d)\.norm\.", r".bn\1."),
    (r"^backbone\.top_block\.", "backbone.fpn.extra_blocks."),
    (r"^proposal_generator\.rpn_head\.conv\.", "rpn.head.conv.0.0."),
    (r"^proposal_generator\.rpn_head\.objectness_logits\.", "rpn.head.cls_logits."),
    (r"^proposal_generator\.rpn_head\.anchor_deltas\.", "rpn.head.bbox_pred."),
    (r"^roi_heads\.box_head\.fc1\.", "roi_heads.box_head.fc6."),
    (r"^roi_heads\.box_head\.fc2\.", "roi_heads.box_head.fc7."),
    (r"^head\.(cls|bbox)_subnet\.(\d)\.", lambda found: _hidden(found[1], int(found[2]))),
    (r"^head\.cls_score\.", "head.classification_head.cls_logits."),
    (r"^head\.bbox_pred\.", "head.regression_head.bbox_reg."),
)
_HEADS = {"cls": "classification_head", "bbox": "regression_head"}


def _hidden(branch: str, place: int) -> str:
    # Between two convolutions lies an activation.
    return f"head.{_HEADS[branch]}.conv.{place // 2}.0."


class _BoxHead(Struct, rename=str.upper):
    """How Faster R-CNN samples a region; all else is refused."""

    pooler_type: Literal["ROIAlignV2"]
    pooler_resolution: Literal[7]
    pooler_sampling_ratio: Literal[0]
    cls_agnostic_bbox_reg: Literal[False] = False


def is_detectron2(state: Mapping[str, Tensor]) -> bool:
    """Whether weights are those of a Detectron2 network on a ResNet pyramid."""
    return all(mark in state for mark in _MARKS)


def read_detectron2(checkpoint: Checkpoint, state: dict[str, Tensor]) -> ReadNetwork:
    """Reads the network, and brings `state` into the form of torchvision.

    Classes are numbers from 0, as in Detectron2. Those of Faster R-CNN begin with the background.
    """
    beside = checkpoint.path.with_name("config.yaml")
    try:
        with beside.open("rb") as file:
            told = yaml.safe_load(file.read(10**6))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise StoredFileError(
            f"{beside} is missing or no YAML of plain values; give the weights in the folder where "
            "the trainer wrote config.yaml beside them."
        ) from error
    plan = detectron2_plan(told)
    if not plan.one_stage:
        head = told["MODEL"].get("ROI_BOX_HEAD")
        check_document(head, _BoxHead, f"{beside}, MODEL.ROI_BOX_HEAD", DETECTRON2_REMEDY)
    # Masks change no box.
    renamed = {
        _renamed(name, 3 if plan.one_stage else 2): tensor
        for name, tensor in state.items()
        if not name.startswith("roi_heads.mask_head.")
    }
    state.clear()
    state.update(renamed)
    if plan.input.format == "BGR":
        state[_FIRST] = state[_FIRST].flip(1)
    if plan.one_stage:
        rows = state.get("head.classification_head.cls_logits.bias", torch.zeros(0))
        anchors = plan.model.anchor_generator
        known = len(rows) // (len(anchors.sizes[0]) * len(anchors.aspect_ratios[0]))
        classes = [*map(str, range(known))]
    else:
        classes = ["background", *map(str, range(_background_first(state)))]
    vehicles = class_positions(checkpoint.vehicle_classes, classes)
    return ReadNetwork(to_builtins(plan), classes, vehicles, side_px=plan.input.min_size_test)


def colours_of(plan: Detectron2Plan) -> tuple[list[float], list[float]]:
    """Mean and deviation of red, green and blue in [0, 1]."""
    turn = -1 if plan.input.format == "BGR" else 1
    mean, deviation = (
        [value / 255 for value in each[::turn]]
        for each in (plan.model.pixel_mean, plan.model.pixel_std)
    )
    return mean, deviation


def detectron2_model(plan: Detectron2Plan, classes: int) -> Any:
    """Builds torchvision's network with the anchors and region samples of Detectron2."""
    model, sides_px = plan.model, plan.model.anchor_generator.sizes
    name = f"resnet{model.resnets.depth}"
    levels: dict[str, Any] = {"weights": None, "norm_layer": nn.BatchNorm2d}
    if plan.one_stage:
        extra = LastLevelP6P7(2048, 256)
        levels |= {"returned_layers": [2, 3, 4], "extra_blocks": extra}
    backbone = resnet_fpn_backbone(backbone_name=name, **levels)
    for stage in ("layer2", "layer3", "layer4") if model.resnets.stride_in_1x1 else ():
        block = backbone.body[stage][0]
        block.conv1.stride, block.conv2.stride = block.conv2.stride, block.conv1.stride
    strides_px = [8, 16, 32, 64, 128] if plan.one_stage else [4, 8, 16, 32, 64]
    if len(sides_px) not in (1, len(strides_px)):
        raise ConfigurationError(
            f"it has anchors for {len(sides_px)} levels, and 1 or 5 are expected; "
            f"{DETECTRON2_REMEDY}."
        )
    sides_px = sides_px * (5 if len(sides_px) == 1 else 1)
    anchors = _FixedAnchors(sides_px, model.anchor_generator.aspect_ratios[0], strides_px)
    if plan.one_stage:
        return detection.RetinaNet(backbone, classes, anchor_generator=anchors)
    pool = _AlignedPool(["0", "1", "2", "3"], 7, 0)
    return detection.FasterRCNN(backbone, classes, rpn_anchor_generator=anchors, box_roi_pool=pool)


class _FixedAnchors(AnchorGenerator):
    """Anchors of exact sides at fixed strides; those of one side stand together."""

    def __init__(
        self, sides_px: list[list[float]], ratios: list[float], strides_px: list[int]
    ) -> None:
        super().__init__(sides_px, (ratios,) * len(sides_px))
        self._strides_px = strides_px

    def generate_anchors(
        self, scales: Any, aspect_ratios: Any, *where: Any, **named: Any
    ) -> Tensor:
        """Corners (xyxy) around 0 of each side with each ratio of height and width."""
        halves = [
            (side / ratio**0.5 / 2, side * ratio**0.5 / 2)
            for side in scales
            for ratio in aspect_ratios
        ]
        return torch.tensor([(-across, -down, across, down) for across, down in halves])

    def grid_anchors(self, grid_sizes: Any, strides: Any) -> list[Tensor]:
        """torchvision divides the image's side by that of the level, which may be rounded."""
        return super().grid_anchors(grid_sizes, [[px, px] for px in self._strides_px])


class _AlignedPool(ops.MultiScaleRoIAlign):
    """RoIAlign with half a pixel's shift and as many samples as a bin has pixels."""

    def forward(
        self, x: dict[str, Tensor], boxes: list[Tensor], image_shapes: list[tuple[int, int]]
    ) -> Tensor:
        """Samples regions (pixel xyxy) on the level that fits their size."""
        strides_px = [4.0, 8.0, 16.0, 32.0]
        levels = area_levels(torch.cat(boxes), strides_px)
        by_image = levels.split([len(each) for each in boxes])
        channels = x["0"].shape[1]
        pooled = x["0"].new_zeros(len(levels), channels, *self.output_size)
        for number, stride_px in enumerate(strides_px):
            own = [each[which == number] for each, which in zip(boxes, by_image, strict=True)]
            features = x[str(number)]
            found = ops.roi_align(features, own, self.output_size, 1 / stride_px, 0, aligned=True)
            pooled = pooled.index_put((torch.nonzero(levels == number)[:, 0],), found)
        return pooled


def _renamed(name: str, first_level: int) -> str:
    found = re.fullmatch(r"backbone\.fpn_(lateral|output)(\d)\.(\w+)", name)
    if found:
        kind = {"lateral": "inner", "output": "layer"}[found[1]]
        return f"backbone.fpn.{kind}_blocks.{int(found[2]) - first_level}.0.{found[3]}"
    for old, new in _NAMES:
        name = re.sub(old, new, name)
    return name


def _background_first(state: dict[str, Tensor]) -> int:
    """Puts the background, the last class of Detectron2, first; returns the number of others."""
    place, known = "roi_heads.box_predictor.", 0
    for name in [name for name in state if name.startswith(place)]:
        rows = state[name]
        if name.startswith(f"{place}cls_score."):
            state[name], known = rows.roll(1, dims=0), len(rows) - 1
        else:
            # The background has no box; nothing reads its four rows.
            state[name] = torch.cat([torch.zeros_like(rows[:4]), rows])
    return max(known, 0)
