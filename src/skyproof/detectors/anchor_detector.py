"""The YOLOv5 of 2020, with anchors and objectness: trained here or imported.

Source of head and loss: the formulas of github.com/ultralytics/yolov5, release 7.0; its code is not
used.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import box_convert, complete_box_iou_loss

from skyproof.detectors.detector import (
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.ultralytics_detectors import build_model, yolov5_architecture

# Anchors of release 7.0 for three levels, chosen on COCO. Six of the nine match a vehicle of 4 m at
# 12.5 cm per pixel (from a fourth to four times its size).
_ANCHORS_PX = (
    (10, 13, 16, 30, 33, 23),
    (30, 61, 62, 45, 59, 119),
    (116, 90, 156, 198, 373, 326),
)
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
    """The head's output: centre, size, objectness and classes by level; and its inputs."""

    levels: list[Float[Tensor, "B A _ _ N"]]
    features: list[Float[Tensor, "B _ _ _"]]


class AnchorHead(nn.Module):
    """One 1x1 convolution per level; boxes are relative to anchors (width and height in pixels)."""

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
        levels = []
        for convolution, level in zip(self.m, features, strict=True):
            images, _, height, width = level.shape
            raw = convolution(level).view(images, -1, self.numbers, height, width)
            levels.append(raw.permute(0, 1, 3, 4, 2))
        return AnchorAnswers(levels, list(features))

    def decoded(
        self, answers: AnchorAnswers
    ) -> tuple[Float[Tensor, "B K 4"], Float[Tensor, "B K"], Float[Tensor, "B K N"]]:
        """Every anchor's box (pixel xyxy), and its logits of an object and of each class."""
        found = []
        for number, raw in enumerate(answers.levels):
            centres, sizes = self.centred(raw, number)
            rows, columns = (torch.arange(side, device=raw.device) for side in raw.shape[2:4])
            cells = torch.cartesian_prod(rows, columns).flip(1).view(*raw.shape[2:4], 2).float()
            centres = (centres + cells) * self.strides_px[number]
            halves = sizes * self.strides_px[number] / 2
            corners = torch.cat([centres - halves, centres + halves], dim=-1)
            each = torch.cat([corners, raw[..., 4:]], dim=-1)
            found.append(each.flatten(1, 3))
        every = torch.cat(found, dim=1)
        return every[..., :4], every[..., 4].contiguous(), every[..., 5:]

    def anchors_of(self, level: int) -> Float[Tensor, "A 2"]:
        """A level's anchors in units of its cells."""
        return self.anchors_px[level] / self.strides_px[level]

    def centred(self, raw: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Centres relative to the cell's corner, and sizes, both in cells."""
        centres = raw[..., :2].sigmoid() * 2 - 0.5
        anchors = self.anchors_of(level)[:, None, None]
        return centres, (raw[..., 2:4].sigmoid() * 2) ** 2 * anchors


def anchor_loss(
    head: AnchorHead, answers: AnchorAnswers, targets: Sequence[Float[Tensor, "_ 4"]]
) -> Float[Tensor, " B"]:
    """YOLOv5's loss of boxes and objectness per image, for one class.

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
    truth = torch.cat(list(targets)).to(answers.levels[0])
    counts = torch.tensor([len(own) for own in targets], device=truth.device)
    whose = torch.arange(images, device=truth.device).repeat_interleave(counts)
    losses = truth.new_zeros(images)
    for number, raw in enumerate(answers.levels):
        wanted = torch.zeros_like(raw[..., 4])
        box, anchor, row, column = _positives(head, number, truth, raw.shape[2], raw.shape[3])
        if len(box):
            image = whose[box]
            place = (image, anchor, row, column)
            # Boxes in units of cells.
            centres, sizes = head.centred(raw, number)
            found = torch.cat([centres[place], sizes[place]], dim=1)
            offset = box_convert(truth[box] / head.strides_px[number], "xyxy", "cxcywh")
            offset[:, :2] -= torch.stack([column, row], dim=1)
            missing = complete_box_iou_loss(
                *(box_convert(each, "cxcywh", "xyxy") for each in (found, offset))
            )
            count = truth.new_zeros(images).index_add(0, image, torch.ones_like(missing))
            summed = truth.new_zeros(images).index_add(0, image, missing)
            losses = losses + _BOX_GAIN * gain * summed / count.clamp(min=1)
            # Objectness should tell how good the box is.
            quality = (1 - missing.detach()).clamp(min=0)
            places = torch.arange(wanted.numel(), device=raw.device).view_as(wanted)[place]
            wanted = wanted.flatten().scatter_reduce(0, places, quality, "amax").view_as(wanted)
        entropy = functional.binary_cross_entropy_with_logits(raw[..., 4], wanted, reduction="none")
        losses = losses + object_gain * weights[number] * entropy.mean(dim=(1, 2, 3))
    return losses


def _positives(
    head: AnchorHead, level: int, truth: Tensor, height: int, width: int
) -> tuple[Int[Tensor, " P"], ...]:
    """Pairs boxes and anchors of similar size, by their numbers of box, anchor, row and column."""
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
    rows, columns = cell[:, 1].clamp(0, height - 1), cell[:, 0].clamp(0, width - 1)
    return box[row], anchor[row], rows, columns


class AnchorDetector(TrainableDetector):
    """Ultralytics' backbone and neck with head and loss of the YOLOv5 of 2020 (section 5.3)."""

    name = "yolov5_anchors"
    model: Any

    def __init__(
        self, architecture: Mapping[str, Any], vehicle_classes: Sequence[int], size: str
    ) -> None:
        super().__init__()
        self.size = size
        self.vehicle_classes = list(vehicle_classes)
        plain = {name: value for name, value in architecture.items() if name != "anchors"}
        *necks, (sources, _, _, _) = architecture["head"]
        # Built with Ultralytics' own head for one class, which tells channels and strides, and
        # whose number of classes cannot be taken for a number of channels.
        plain |= {"nc": 1, "head": [*necks, [sources, 1, "Detect", ["nc"]]]}
        self.model = build_model(plain)
        replaced = self.model.model[-1]
        head: Any = AnchorHead(
            [branch[0].conv.in_channels for branch in replaced.cv2],
            architecture["nc"],
            torch.tensor(architecture["anchors"], dtype=torch.float32).unflatten(1, (-1, 2)),
            self.model.stride.tolist(),
        )
        # Ultralytics' model requires of every layer the source of its input, and its number.
        head.f, head.i, head.type = replaced.f, replaced.i, "AnchorHead"
        self.model.model[-1] = head

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """See `anchor_loss`; against an empty truth, no anchor should be an object."""
        check_targets(images, targets)
        return anchor_loss(self._head, self._answers(images), targets)

    def candidates(self, images: Images) -> Candidates:
        """Every anchor's box, scored by objectness times the score of its best vehicle class."""
        boxes, objectness, classes = self._head.decoded(self._answers(images))
        likely = classes[..., self.vehicle_classes].amax(dim=-1)
        scores = objectness.sigmoid() * likely.sigmoid()
        return Candidates(boxes, scores, torch.ones_like(scores, dtype=torch.bool))

    @torch.no_grad()
    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; the features are the inputs of the head."""
        levels = self._answers(images).features
        return levels, round(levels[0].shape[-1] * self._head.strides_px[0])

    @property
    def _head(self) -> AnchorHead:
        head = self.model.model[-1]
        assert isinstance(head, AnchorHead)
        return head

    def _answers(self, images: Tensor) -> AnchorAnswers:
        check_images(images)
        stride_px = int(max(32, *self._head.strides_px))
        # 114/255 is the grey YOLOv5 pads with.
        answers: AnchorAnswers = self.model(pad_to_stride(images, 114 / 255, stride_px))
        return answers


def trainable_architecture(size: str) -> dict[str, Any]:
    """The one-class architecture of a size: YOLOv5n ("slim") to YOLOv5s ("full")."""
    return {**yolov5_architecture(size), "nc": 1, "anchors": [list(row) for row in _ANCHORS_PX]}
