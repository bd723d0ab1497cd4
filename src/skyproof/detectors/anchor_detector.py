"""The YOLOv5 of 2020, with anchors and objectness: trained here or imported."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.detectors.anchor_head import AnchorAnswers, AnchorHead, anchor_loss
from skyproof.detectors.common import check_images, check_targets, pad_to_stride
from skyproof.detectors.detector import Boxes, Candidates, Images, TrainableDetector
from skyproof.detectors.ultralytics_detectors import build_model, yolov5_architecture

# Anchors of release 7.0 for three levels, chosen on COCO. Six of the nine match a vehicle of 4 m at
# 12.5 cm per pixel (from a fourth to four times its size).
_ANCHORS_PX = (
    (10, 13, 16, 30, 33, 23),
    (30, 61, 62, 45, 59, 119),
    (116, 90, 156, 198, 373, 326),
)


class AnchorDetector(TrainableDetector):
    """Ultralytics' backbone and neck with the head and loss of the YOLOv5 of 2020 (section 5.3).

    The architecture is checked by `check_layers` and has "anchors" per level. A box gets the best
    score among the vehicle classes. `size` is for tables.
    """

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
        """YOLOv5's own loss per image (`anchor_loss`).

        Against an empty truth, no anchor should be an object of any class.
        """
        check_targets(images, targets)
        return anchor_loss(self._head, self._answers(images), targets)

    def candidates(self, images: Images) -> Candidates:
        """Every anchor's box, scored by objectness times the score of its best vehicle class."""
        answers = self._answers(images)
        classes = self._head.classes(answers)[..., self.vehicle_classes].amax(dim=-1)
        scores = self._head.objectness(answers).sigmoid() * classes.sigmoid()
        boxes = self._head.boxes(answers)
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
