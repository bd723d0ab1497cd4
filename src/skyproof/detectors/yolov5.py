"""YOLOv5 through Ultralytics: the only file that imports it.

NOTICE: Ultralytics is licensed under AGPL-3.0. skyproof itself (Apache-2.0) neither contains nor requires it;
installing the extra `skyproof[yolo]` and using this detector brings the terms of the AGPL-3.0 with it, for network
services too.

What Ultralytics builds today under this name is YOLOv5u: the backbone and neck of YOLOv5 with the anchor-free head and
the task-aligned loss of YOLOv8. The anchor-based YOLOv5 of 2020, which the paper may have used, is not in the package.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from skyproof.detectors.common import check_images, check_targets, pad_to_stride, suppress
from skyproof.detectors.detector import Candidates, Detections, TrainableDetector
from skyproof.errors import ConfigurationError

__all__ = ["YoloV5Detector"]

MODEL_FILES = {"slim": "yolov5n.yaml", "full": "yolov5s.yaml"}
# The assigner gives a vehicle ten anchor points; an empty truth's sum is divided by as many (PAPER 22).
POINTS_PER_VEHICLE = 10.0


class YoloV5Detector(TrainableDetector):
    """Ultralytics' YOLOv5u for one class, from its YAML, without weights and never fused (PAPER 15).

    Args:
        size: "slim" (YOLOv5n, 2.5 M parameters) or "full" (YOLOv5s, 9.1 M).

    Raises:
        ConfigurationError: ultralytics is not installed, or another size.
    """

    name = "yolov5"
    model: Any

    def __init__(self, size: str) -> None:
        super().__init__()
        if size not in MODEL_FILES:
            raise ConfigurationError(f'A detector size is "slim" or "full", not "{size}".')
        self.size = size
        with _quiet_import():
            from ultralytics.nn.tasks import DetectionModel
            from ultralytics.utils import DEFAULT_CFG

            self.model = DetectionModel(MODEL_FILES[size], nc=1, verbose=False)
        self.model.args = DEFAULT_CFG
        self._criterion: Any = None

    def loss(self, images: Float[Tensor, "B 3 H W"], targets: Sequence[Float[Tensor, "_ 4"]]) -> Float[Tensor, " B"]:
        """Ultralytics' own v8DetectionLoss (box, class, distribution) image by image on one forward pass.

        Its sums are already divided by the target scores, but by 1 with an empty truth; then they are divided by the
        ten points a vehicle gets. Called per image, its factor "batch size" is 1 (PAPER 21, 22).
        """
        check_targets(images, targets)
        outputs = self._outputs(images)
        criterion = self._criterion_on(images.device)
        height, width = (side * 8 for side in outputs["feats"][0].shape[-2:])
        losses = []
        for index, boxes in enumerate(targets):
            own = {
                "boxes": outputs["boxes"][index : index + 1],
                "scores": outputs["scores"][index : index + 1],
                "feats": [level[index : index + 1] for level in outputs["feats"]],
            }
            sides = boxes[:, 2:] - boxes[:, :2]
            centred = torch.cat([boxes[:, :2] + sides / 2, sides], dim=1) / boxes.new_tensor(
                [width, height, width, height]
            )
            zeros = boxes.new_zeros(len(boxes))
            terms, _ = criterion(own, {"batch_idx": zeros, "cls": zeros, "bboxes": centred})
            losses.append(terms.sum() / (1.0 if len(boxes) else POINTS_PER_VEHICLE))
        return torch.stack(losses)

    def candidates(self, images: Float[Tensor, "B 3 H W"]) -> Candidates:
        """Every anchor point's box and sigmoid score."""
        from ultralytics.utils.tal import make_anchors

        outputs = self._outputs(images)
        points, strides = make_anchors(outputs["feats"], self.model.stride.to(images.device), 0.5)
        boxes = self._criterion_on(images.device).bbox_decode(points, outputs["boxes"].permute(0, 2, 1).contiguous())
        scores = outputs["scores"][:, 0].sigmoid()
        return Candidates(boxes * strides, scores, torch.ones_like(scores, dtype=torch.bool))

    @torch.no_grad()
    def detect(self, images: Float[Tensor, "B 3 H W"]) -> list[Detections]:
        """See `Detector.detect`."""
        return suppress(self.candidates(images), images.shape[-2], images.shape[-1])

    def _outputs(self, images: Tensor) -> dict[str, Any]:
        """Raw heads: boxes `[B, 64, A]`, scores `[B, 1, A]`, feature maps; the same in both modes."""
        check_images(images)
        # 114/255 is the grey Ultralytics pads with.
        outputs = self.model(pad_to_stride(images, value=114 / 255))
        # In eval mode the head returns (decoded, raw); only raw knows no cached anchors.
        return outputs[1] if isinstance(outputs, tuple) else outputs

    def _criterion_on(self, device: torch.device) -> Any:
        if self._criterion is None or self._criterion.device != device:
            from ultralytics.utils.loss import v8DetectionLoss

            self._criterion = v8DetectionLoss(self.model)
        return self._criterion


@contextmanager
def _quiet_import() -> Iterator[None]:
    """Imports Ultralytics without network, usage statistics, log lines, a settings file at home or patched libraries.

    Its import sets OMP_NUM_THREADS, writes `settings.json` into the user's configuration folder, replaces `torch.save`,
    and replaces Pillow's `Image.open` by one that installs packages when it meets a damaged file; all are undone. Where
    the program imported Ultralytics before us, its settings stay as they are.
    """
    logger = logging.getLogger("ultralytics")
    level, environment, save, image_open = logger.level, dict(os.environ), torch.save, Image.open
    with tempfile.TemporaryDirectory(prefix="skyproof-yolo-") as folder:
        os.environ.update({"YOLO_OFFLINE": "true", "YOLO_CONFIG_DIR": folder, "YOLO_VERBOSE": "false"})
        first = "ultralytics" not in sys.modules
        logger.setLevel(logging.ERROR)
        try:
            from ultralytics.utils import SETTINGS

            logger.setLevel(logging.ERROR)
            if first:
                SETTINGS["sync"] = False
            yield
        except ModuleNotFoundError as error:
            raise ConfigurationError(
                'YOLOv5 needs Ultralytics (AGPL-3.0), which is not installed: pip install "skyproof[yolo]".'
            ) from error
        finally:
            torch.save, Image.open = save, image_open
            os.environ.clear()
            os.environ.update(environment)
            logger.setLevel(level)
