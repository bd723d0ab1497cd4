"""YOLO through Ultralytics, trained here or imported: the only file that imports it.

NOTICE: Ultralytics is licensed under AGPL-3.0. skyproof itself (Apache-2.0) neither contains nor
requires it; installing the extra `skyproof[yolo]` and using this detector brings the terms of the
AGPL-3.0 with it, for network services too.

Under the name YOLOv5 Ultralytics now builds YOLOv5u: the backbone and neck of YOLOv5 with the
anchor-free head and the task-aligned loss of YOLOv8. `anchor_detector` implements the YOLOv5 of
2020 with anchors, on the backbone and neck that this file builds.
"""

import copy
import logging
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn import functional

from skyproof.detectors.blueprint import QUERIES, TURNED, Blueprint, check_layers
from skyproof.detectors.cost import SIDE_PX, measured
from skyproof.detectors.detector import (
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.query_detector import Answers, QueryDetector
from skyproof.errors import ConfigurationError

# Layer widths in Ultralytics' YAML file: those of its YOLOv5n and its YOLOv5s.
WIDTH_FACTORS = {"slim": 0.25, "full": 0.5}
# The assigner gives a vehicle ten anchor points, so the sum of an empty truth is divided by ten.
POINTS_PER_VEHICLE = 10.0
# Ultralytics' weight of the class loss.
CLASS_GAIN = 0.5
# The widest window of a layer.
_WINDOWS = {"kernel_size": (1, 31), "stride": (1, 8), "padding": (0, 31), "dilation": (1, 8)}


class YoloDetector(TrainableDetector):
    """A network of Ultralytics. A box gets the best score among the vehicle classes.

    An oriented box is replaced by the upright box around it. YOLOv10 and YOLO26 have two heads; the
    one that the installed Ultralytics reads is used.
    """

    model: Any
    vehicle_classes: Sequence[int]

    def candidates(self, images: Images) -> Candidates:
        """Every anchor point's box and best sigmoid score."""
        from ultralytics.utils.tal import dist2bbox, dist2rbox, make_anchors

        outputs = self._outputs(images)
        points, strides = make_anchors(outputs["feats"], self.model.stride.to(images.device), 0.5)
        distances = outputs["boxes"].permute(0, 2, 1)
        levels = self.model.model[-1].reg_max
        if levels > 1:
            steps = torch.arange(levels, dtype=distances.dtype, device=distances.device)
            distances = distances.reshape(*distances.shape[:2], 4, levels).softmax(-1) @ steps
        if "angle" in outputs:
            angles = outputs["angle"].permute(0, 2, 1)
            boxes = upright(dist2rbox(distances, angles, points), angles)
        else:
            boxes = dist2bbox(distances, points, xywh=False)
        scores = outputs["scores"][:, list(self.vehicle_classes)].amax(dim=1).sigmoid()
        return Candidates(boxes * strides, scores)

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """Returns Ultralytics' own v8DetectionLoss of each image, from one forward pass.

        Its sums are already divided by the target scores. With an empty truth they are the class
        loss of all vehicle classes; that is divided by the ten points a vehicle gets. Where a
        network tells several vehicle classes apart, the likeliest of each point is the right one.
        A call sees one image, so its factor "batch size" is 1.
        """
        check_targets(images, targets)
        outputs = self._outputs(images)
        logits = outputs["scores"][:, list(self.vehicle_classes)]
        empty = CLASS_GAIN * functional.softplus(logits).sum(dim=(1, 2)) / POINTS_PER_VEHICLE
        if not any(map(len, targets)):
            return empty
        criterion = self._criterion()
        stride_px = float(self.model.stride[0])
        height, width = (side * stride_px for side in outputs["feats"][0].shape[-2:])
        losses = []
        for index, boxes in enumerate(targets):
            own = {
                "boxes": outputs["boxes"][index : index + 1],
                "scores": logits[index : index + 1].amax(dim=1, keepdim=True),
                "feats": [level[index : index + 1] for level in outputs["feats"]],
            }
            sides = boxes[:, 2:] - boxes[:, :2]
            centred = torch.cat([boxes[:, :2] + sides / 2, sides], dim=1)
            centred = centred / boxes.new_tensor([width, height] * 2)
            zeros = boxes.new_zeros(len(boxes))
            terms, _ = criterion(own, {"batch_idx": zeros, "cls": zeros, "bboxes": centred})
            losses.append(terms.sum() if len(boxes) else empty[index])
        return torch.stack(losses)

    def _criterion(self) -> Any:
        """Returns Ultralytics' loss for the head in use, with vehicles as a single class."""
        from ultralytics.utils import DEFAULT_CFG
        from ultralytics.utils.loss import v8DetectionLoss

        self.model.args = DEFAULT_CFG
        # As in Ultralytics' E2ELoss, a head without suppression assigns one point to a vehicle.
        assigned = {"tal_topk": 7, "tal_topk2": 1} if self.model.model[-1].end2end else {}
        criterion = v8DetectionLoss(self.model, **assigned)
        criterion.assigner.num_classes = 1
        return criterion

    @torch.no_grad()
    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; the features are the inputs of the head."""
        levels = self._outputs(images)["feats"]
        return levels, round(levels[0].shape[-1] * float(self.model.stride.min()))

    def _outputs(self, images: Tensor) -> dict[str, Any]:
        """The raw head, the same in both modes: boxes `[B, _, A]`, scores `[B, _, A]`, features."""
        check_images(images)
        stride_px = max(32, int(self.model.stride.max()))
        # 114/255 is the grey Ultralytics pads with.
        outputs = self.model(pad_to_stride(images, value=114 / 255, stride_px=stride_px))
        # In eval mode the head returns (decoded, raw); only raw knows no cached anchors.
        raw: dict[str, Any] = outputs[1] if isinstance(outputs, tuple) else outputs
        if "one2one" in raw:
            return raw["one2one" if self.model.model[-1].end2end else "one2many"]
        return raw


class YoloV5Detector(YoloDetector):
    """Ultralytics' YOLOv5u for one class (section 5.3), built without weights and never fused.

    Size "slim" is YOLOv5n with 2.5 M parameters, "full" YOLOv5s with 9.1 M.
    """

    name = "yolov5"
    vehicle_classes = (0,)

    def __init__(self, size: str) -> None:
        super().__init__()
        self.size = size
        architecture = yolov5_architecture(size)
        with _quiet_import():
            from ultralytics.nn.tasks import DetectionModel

            self.model = DetectionModel(architecture, nc=1, verbose=False)
        _activate_pooling(self.model, architecture)


class YoloNetwork(YoloDetector):
    """Any recent Ultralytics YOLO with any classes, without its weights."""

    def __init__(self, architecture: Mapping[str, Any], vehicle_classes: Sequence[int]) -> None:
        super().__init__()
        self.vehicle_classes = list(vehicle_classes)
        self.model = build_model(architecture)


class RtDetrNetwork(QueryDetector):
    """An RT-DETR of Ultralytics with any classes, without its weights."""

    focal_exponent = 1.5

    def __init__(self, blueprint: Blueprint, side_px: int) -> None:
        architecture: Any = blueprint.architecture
        model = build_model(architecture)
        super().__init__(blueprint.vehicle_classes, int(model.model[-1].nc), side_px)
        self.model = model
        # Ultralytics' trainer tells it for the loss.
        self.model.nc = self.classes

    def answers(self, seen: Tensor) -> Answers:
        """See `QueryDetector.answers`; only in training the library cuts gradients."""
        _, (boxes, logits, *_) = self.model(seen)
        return Answers(logits[-1], boxes[-1])

    def cost(self, seen: Tensor, classes: Tensor, boxes: Tensor) -> Tensor:
        truth = {"img": seen, "batch_idx": 0 * classes, "cls": classes, "bboxes": boxes}
        loss: Tensor = self.model.loss(truth, self.model(seen))[0]
        return loss.sum()

    def features(self, seen: Tensor) -> list[Tensor]:
        """See `QueryDetector.features`; the features are the inputs of the decoder."""
        levels: list[Tensor] = []
        head = self.model.model[-1]
        hook = head.register_forward_pre_hook(lambda _, inputs: levels.extend(inputs[0]))
        self.model(seen)
        hook.remove()
        return levels


def yolov5_architecture(size: str) -> dict[str, Any]:
    """Returns the architecture of Ultralytics' YOLOv5n with the layer width of `size`."""
    with _quiet_import():
        from ultralytics.nn.tasks import yaml_model_load

        architecture: dict[str, Any] = yaml_model_load("yolov5n.yaml")
    depth, _, most_channels = architecture["scales"]["n"]
    architecture["scales"]["n"] = [depth, WIDTH_FACTORS[size], most_channels]
    return architecture


def build_model(architecture: Mapping[str, Any]) -> Any:
    """Builds a stranger's network, checked by `check_layers`, without its weights."""
    check_layers(architecture)
    with _quiet_import():
        from ultralytics.nn.modules.conv import Conv
        from ultralytics.nn.tasks import DetectionModel, OBBModel, RTDETRDetectionModel

        special = {**dict.fromkeys(TURNED, OBBModel), QUERIES: RTDETRDetectionModel}
        kind = special.get(architecture["head"][-1][2], DetectionModel)
        # The library would use an architecture's activation for all later networks.
        usual = Conv.default_act
        try:
            _refuse_giants(architecture)
            model = kind(copy.deepcopy(dict(architecture)), ch=3, verbose=False)
        except ConfigurationError:
            raise
        except Exception as error:
            # A row of numbers can raise any exception in another library.
            raise ConfigurationError(
                "the installed Ultralytics cannot build the network "
                f"({' '.join(str(error).split())[:200]}); install the version that trained it."
            ) from error
        finally:
            Conv.default_act = usual
    _activate_pooling(model, architecture)
    return model


def _activate_pooling(model: Any, architecture: Mapping[str, Any]) -> None:
    """Activates the first convolution of SPPF rows without a number, as most releases do."""
    rows = [*architecture["backbone"], *architecture["head"]]
    for layer, (_, _, name, given) in zip(model.model, rows, strict=True):
        if name == "SPPF" and len(given) < 3:
            blocks: Any = layer if isinstance(layer, torch.nn.Sequential) else [layer]
            for block in blocks:
                block.cv1.act = block.cv2.act


def _refuse_giants(architecture: Mapping[str, Any]) -> None:
    """Builds and runs a network without memory for its numbers, to measure it first."""
    from ultralytics.nn.tasks import parse_model

    plan = copy.deepcopy(dict(architecture))
    answers: list[Tensor | None] = []
    with measured():
        layers, kept = parse_model(plan, ch=3, verbose=False)
        _refuse_wide_windows(layers)
        answer: Any = torch.zeros(1, 3, SIDE_PX, SIDE_PX)
        for layer in layers:
            if layer.f != -1:
                sources = [layer.f] if isinstance(layer.f, int) else layer.f
                given = [answer if source == -1 else answers[source] for source in sources]
                answer = given[0] if isinstance(layer.f, int) else given
            answer = layer(answer)
            answers.append(answer if layer.i in kept else None)


def _refuse_wide_windows(layers: torch.nn.Module) -> None:
    """Refuses layers that see far more of an image at once than those of a detector do."""
    for layer in layers.modules():
        for name, (least, most) in _WINDOWS.items():
            value = getattr(layer, name, None)
            sides = value if isinstance(value, tuple | list) else [value]
            wide = [s for s in sides if isinstance(s, int) and not least <= s <= most]
            if wide:
                raise ConfigurationError(
                    f"the network has a layer with {name} {wide[0]}, expected {least} to {most}; "
                    "give the architecture of a detector."
                )


def upright(boxes: Tensor, angles: Tensor) -> Tensor:
    """Returns the upright boxes (xyxy) around oriented boxes `[..., 4]` of centre and sides."""
    centres, (width, height) = boxes[..., :2], (boxes[..., 2:] / 2).split(1, dim=-1)
    cosine = angles.cos().abs()
    sine = angles.sin().abs()
    half = torch.cat([width * cosine + height * sine, width * sine + height * cosine], dim=-1)
    return torch.cat([centres - half, centres + half], dim=-1)


@contextmanager
def _quiet_import() -> Iterator[None]:
    """Imports Ultralytics without side effects: no network, statistics, log line or settings file.

    Its import sets OMP_NUM_THREADS, writes `settings.json` into the user's configuration folder,
    and replaces `torch.save`, and Pillow's `Image.open` by one that installs packages when it meets
    a damaged file. All are undone. If the program imported Ultralytics before, its settings stay.
    """
    logger = logging.getLogger("ultralytics")
    level = logger.level
    environment = dict(os.environ)
    save = torch.save
    image_open = Image.open
    with tempfile.TemporaryDirectory(prefix="skyproof-yolo-") as folder:
        os.environ.update(
            {"YOLO_OFFLINE": "true", "YOLO_CONFIG_DIR": folder, "YOLO_VERBOSE": "false"}
        )
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
                "YOLOv5 needs Ultralytics (AGPL-3.0), which is not installed: "
                'pip install "skyproof[yolo]".'
            ) from error
        finally:
            torch.save, Image.open = save, image_open
            os.environ.clear()
            os.environ.update(environment)
            logger.setLevel(level)
