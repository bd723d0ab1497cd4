"""The head and the loss of the YOLOv5 of 2020: anchors and objectness, in plain torch.

Source: the formulas of github.com/ultralytics/yolov5, release 7.0; its code is not used.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import box_convert, complete_box_iou_loss

# The source's settings for training from scratch, for three levels and images of 640 px.
_BOX_GAIN = 0.05
_USUAL_SIDE_PX = 640
_USUAL_LEVELS = 3
# A vehicle matches anchors from a fourth to four times its width and height.
_LARGEST_RATIO = 4.0
# Weights of the levels' objectness, for three levels and for any other number.
_LEVEL_WEIGHTS = {3: (4.0, 1.0, 0.4)}
_MANY_LEVEL_WEIGHTS = (4.0, 1.0, 0.25, 0.06, 0.02)
# The offsets of a cell itself and of the neighbours that a centre may belong to.
_NEIGHBOURS = ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1))


class AnchorAnswers(NamedTuple):
    """The output of the head for B images, the finest level first.

    Attributes:
        levels: raw numbers of each level: centre, size, objectness, classes.
        features: inputs of the head.
    """

    levels: list[Float[Tensor, "B A _ _ N"]]
    features: list[Float[Tensor, "B _ _ _"]]


class AnchorHead(nn.Module):
    """One 1x1 convolution per level; boxes are relative to anchors (width and height in pixels).

    Levels are ordered from the finest; `channels` are those of the features.
    """

    anchors_px: Tensor

    def __init__(
        self,
        channels: Sequence[int],
        class_count: int,
        anchors: Float[Tensor, "L A 2"],
        strides_px: Sequence[float],
    ) -> None:
        super().__init__()
        self.numbers = 5 + class_count
        self.strides_px = [float(stride) for stride in strides_px]
        # The anchors are stored as text beside the weights, so the state dict leaves them out.
        self.register_buffer("anchors_px", anchors, persistent=False)
        count = anchors.shape[1]
        # The checkpoints of 2020 use this name.
        convolutions = [nn.Conv2d(width, count * self.numbers, 1) for width in channels]
        self.m = nn.ModuleList(convolutions)
        for convolution, stride in zip(convolutions, self.strides_px, strict=True):
            assert convolution.bias is not None
            with torch.no_grad():
                bias = convolution.bias.view(count, self.numbers)
                # The source expects about eight objects on an image of 640 px.
                bias[:, 4] += math.log(8 / (_USUAL_SIDE_PX / stride) ** 2)
                bias[:, 5:] += math.log(0.6 / (class_count - 0.99999))

    def forward(self, features: list[Float[Tensor, "B _ _ _"]]) -> AnchorAnswers:
        """Gives the raw numbers of every level."""
        levels = []
        for convolution, level in zip(self.m, features, strict=True):
            images, _, height, width = level.shape
            raw = convolution(level).view(images, -1, self.numbers, height, width)
            levels.append(raw.permute(0, 1, 3, 4, 2))
        return AnchorAnswers(levels, list(features))

    def boxes(self, answers: AnchorAnswers) -> Float[Tensor, "B K 4"]:
        """Decodes every anchor's box, pixel xyxy, in the order of `objectness` and `classes`."""
        found = []
        for number, raw in enumerate(answers.levels):
            centres, sizes = self._centred(raw, number)
            images, _, height, width, _ = raw.shape
            cells = _cells(height, width, raw.device)
            centres = (centres + cells) * self.strides_px[number]
            halves = sizes * self.strides_px[number] / 2
            corners = torch.cat([centres - halves, centres + halves], dim=-1)
            found.append(corners.reshape(images, -1, 4))
        return torch.cat(found, dim=1)

    def objectness(self, answers: AnchorAnswers) -> Float[Tensor, "B K"]:
        """Gathers the logits that an anchor holds any object."""
        return torch.cat([raw[..., 4].flatten(1) for raw in answers.levels], dim=1)

    def classes(self, answers: AnchorAnswers) -> Float[Tensor, "B K N"]:
        """Gathers the logits of each class, given that there is an object."""
        return torch.cat([raw[..., 5:].flatten(1, 3) for raw in answers.levels], dim=1)

    def anchors_of(self, level: int) -> Float[Tensor, "A 2"]:
        """Gives a level's anchors in units of its cells."""
        return self.anchors_px[level] / self.strides_px[level]

    def _centred(self, raw: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Gives centres relative to the cell's corner, and sizes, both in cells."""
        centres = raw[..., :2].sigmoid() * 2 - 0.5
        anchors = self.anchors_of(level)[:, None, None]
        return centres, (raw[..., 2:4].sigmoid() * 2) ** 2 * anchors


def anchor_loss(
    head: AnchorHead, answers: AnchorAnswers, targets: Sequence[Float[Tensor, "_ 4"]]
) -> Float[Tensor, " B"]:
    """YOLOv5's loss of boxes and objectness per image.

    `targets` holds the true boxes of each image, pixel xyxy, all of the one class.

    Differences from the source: the source averages over the positives of a batch; this averages
    over those of each image, so that an image's loss depends on that image alone. If two vehicles
    claim one anchor in one cell, the better box counts, not the last one. There is no class term,
    as in the source for a single class.
    """
    images = len(targets)
    level_count = len(answers.levels)
    weights = _LEVEL_WEIGHTS.get(level_count, _MANY_LEVEL_WEIGHTS)
    gain = _USUAL_LEVELS / level_count
    # Cells of the padding are negatives like all others.
    height_px, width_px = (side * head.strides_px[0] for side in answers.levels[0].shape[2:4])
    object_gain = gain * height_px * width_px / _USUAL_SIDE_PX**2
    whose = torch.cat(
        [torch.full((len(own),), index, dtype=torch.long) for index, own in enumerate(targets)]
    )
    truth = torch.cat(list(targets)).to(answers.levels[0])
    whose = whose.to(truth.device)
    losses = truth.new_zeros(images)
    for number, raw in enumerate(answers.levels):
        wanted = torch.zeros_like(raw[..., 4])
        positive = _positives(head, number, truth, raw.shape[2], raw.shape[3])
        if len(positive.box):
            image = whose[positive.box]
            place = (image, positive.anchor, positive.row, positive.column)
            # Boxes in units of cells.
            centres, sizes = head._centred(raw, number)
            found = torch.cat([centres[place], sizes[place]], dim=1)
            offset = box_convert(truth[positive.box] / head.strides_px[number], "xyxy", "cxcywh")
            offset[:, :2] -= torch.stack([positive.column, positive.row], dim=1)
            missing = complete_box_iou_loss(
                *(box_convert(each, "cxcywh", "xyxy") for each in (found, offset))
            )
            count = truth.new_zeros(images).index_add(0, image, torch.ones_like(missing))
            summed = truth.new_zeros(images).index_add(0, image, missing)
            losses = losses + _BOX_GAIN * gain * summed / count.clamp(min=1)
            # Objectness should tell how good the box is.
            shape = raw.shape[:4]
            flat = torch.zeros(len(missing), dtype=torch.long, device=raw.device)
            for side, index in zip(shape, place, strict=True):
                flat = flat * side + index
            quality = (1 - missing.detach()).clamp(min=0)
            wanted = wanted.flatten().scatter_reduce(0, flat, quality, "amax").view(shape)
        entropy = functional.binary_cross_entropy_with_logits(raw[..., 4], wanted, reduction="none")
        losses = losses + object_gain * weights[number] * entropy.mean(dim=(1, 2, 3))
    return losses


class _Positives(NamedTuple):
    """The anchors, by cell, that should find each true box of a level."""

    box: Int[Tensor, " P"]
    anchor: Int[Tensor, " P"]
    row: Int[Tensor, " P"]
    column: Int[Tensor, " P"]


def _positives(head: AnchorHead, level: int, truth: Tensor, height: int, width: int) -> _Positives:
    """Assigns boxes to anchors of similar size, in their cell and its two nearest neighbours."""
    own = truth / head.strides_px[level]
    sizes = own[:, 2:] - own[:, :2]
    ratio = sizes[None] / head.anchors_of(level)[:, None]
    alike = torch.maximum(ratio, 1 / ratio).amax(dim=2) < _LARGEST_RATIO
    anchor, box = alike.nonzero(as_tuple=True)
    centre = ((own[:, :2] + own[:, 2:]) / 2)[box]
    # A neighbour counts if the centre lies in the half of its cell that borders on it.
    limit = centre.new_tensor([width, height])
    low = (centre % 1 < 0.5) & (centre > 1)
    high = ((limit - centre) % 1 < 0.5) & (limit - centre > 1)
    counted = torch.stack(
        [torch.ones_like(low[:, 0]), low[:, 0], low[:, 1], high[:, 0], high[:, 1]]
    )
    neighbour, row = counted.nonzero(as_tuple=True)
    step = centre.new_tensor(_NEIGHBOURS)[neighbour] / 2
    cell = (centre[row] - step).long()
    return _Positives(
        box[row], anchor[row], cell[:, 1].clamp(0, height - 1), cell[:, 0].clamp(0, width - 1)
    )


def _cells(height: int, width: int, device: torch.device) -> Float[Tensor, "h w 2"]:
    rows, columns = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    return torch.stack([columns, rows], dim=-1).float()
