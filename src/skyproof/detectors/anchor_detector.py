"""The YOLOv5 of 2020, with anchors and objectness, for imported checkpoints.

The head follows the formulas of github.com/ultralytics/yolov5, release 7.0, but uses none of its
code.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from skyproof.detectors.detector import (
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.ultralytics_detectors import build_model

_USUAL_SIDE_PX = 640
_USUAL_LEVELS = 3
# Weights of the levels' objectness, for three levels and for any other number.
_LEVEL_WEIGHTS = {3: (4.0, 1.0, 0.4)}
_MANY_LEVEL_WEIGHTS = (4.0, 1.0, 0.25, 0.06, 0.02)


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
        self.m = nn.ModuleList([nn.Conv2d(width, count * self.numbers, 1) for width in channels])

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
            stride_px = self.strides_px[number]
            # Centres relative to the cell's corner, and sizes, both in cells.
            centres = raw[..., :2].sigmoid() * 2 - 0.5
            anchors = (self.anchors_px[number] / stride_px)[:, None, None]
            sizes = (raw[..., 2:4].sigmoid() * 2) ** 2 * anchors
            rows, columns = (torch.arange(side, device=raw.device) for side in raw.shape[2:4])
            cells = torch.cartesian_prod(rows, columns).flip(1).view(*raw.shape[2:4], 2).float()
            centres = (centres + cells) * stride_px
            halves = sizes * stride_px / 2
            corners = torch.cat([centres - halves, centres + halves], dim=-1)
            found.append(torch.cat([corners, raw[..., 4:]], dim=-1).flatten(1, 3))
        every = torch.cat(found, dim=1)
        return every[..., :4], every[..., 4].contiguous(), every[..., 5:]


class AnchorDetector(TrainableDetector):
    """Ultralytics' backbone and neck with head and loss of the YOLOv5 of 2020 (section 5.3)."""

    model: Any

    def __init__(self, architecture: Mapping[str, Any], vehicle_classes: Sequence[int]) -> None:
        super().__init__()
        self.vehicle_classes = list(vehicle_classes)
        plain = {name: value for name, value in architecture.items() if name != "anchors"}
        *necks, (sources, _, _, _) = architecture["head"]
        # Built with Ultralytics' own head, which reveals channels and strides. It has one class,
        # because that number of classes cannot be mistaken for a number of channels.
        plain |= {"nc": 1, "head": [*necks, [sources, 1, "Detect", ["nc"]]]}
        self.model = build_model(plain)
        replaced = self.model.model[-1]
        head: Any = AnchorHead(
            [branch[0].conv.in_channels for branch in replaced.cv2],
            architecture["nc"],
            torch.tensor(architecture["anchors"], dtype=torch.float32).unflatten(1, (-1, 2)),
            self.model.stride.tolist(),
        )
        # Ultralytics' model expects every layer to know the source of its input and its number.
        head.f, head.i, head.type = replaced.f, replaced.i, "AnchorHead"
        self.model.model[-1] = head

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """Returns YOLOv5's objectness loss per image for an empty truth, padding included."""
        check_targets(images, targets)
        levels = self._answers(images).levels
        height_px, width_px = (side * self._head.strides_px[0] for side in levels[0].shape[2:4])
        gain = _USUAL_LEVELS / len(levels) * height_px * width_px / _USUAL_SIDE_PX**2
        weights = _LEVEL_WEIGHTS.get(len(levels), _MANY_LEVEL_WEIGHTS)
        terms = [functional.softplus(raw[..., 4]).mean(dim=(1, 2, 3)) for raw in levels]
        return gain * (torch.stack(terms, dim=1) @ terms[0].new_tensor(weights[: len(terms)]))

    def candidates(self, images: Images) -> Candidates:
        """Every anchor's box, scored by objectness times the score of its best vehicle class."""
        boxes, objectness, classes = self._head.decoded(self._answers(images))
        likely = classes[..., self.vehicle_classes].amax(dim=-1)
        return Candidates(boxes, objectness.sigmoid() * likely.sigmoid())

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
