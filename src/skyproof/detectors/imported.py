"""Imported detectors at their own resolution, and torchvision's with classes of their own."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import detection
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.ops.feature_pyramid_network import LastLevelP6P7
from torchvision.transforms.functional import normalize

from skyproof.detectors.anchor_detector import AnchorDetector
from skyproof.detectors.blueprint import ARCHITECTURES, QUERIES, Blueprint
from skyproof.detectors.checkpoints import averaged_first
from skyproof.detectors.detector import (
    PADDING_GREY,
    SMALLEST_IMAGE_PX,
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.query_detector import QueryDetector
from skyproof.detectors.torchvision_detectors import (
    FasterRcnnDetector,
    RetinaNetDetector,
    TorchvisionDetector,
)
from skyproof.detectors.transformers_detectors import TransformersNetwork
from skyproof.detectors.ultralytics_detectors import RtDetrNetwork, YoloNetwork
from skyproof.errors import ConfigurationError, is_full_memory

# The mean and deviation of torchvision's own transform.
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
# torchvision enlarges images to 800 px, Ultralytics trains on 640 px, if nothing else is asked.
_USUAL_SIDES_PX = {"torchvision": 800, "ultralytics": 640, "transformers": 640}
_WINDOWS_PX = (192, 2048)
# Four times the largest image that is not split.
_LARGEST_SIDE_PX = 4096


class ImportedDetector(TrainableDetector):
    """A network with imported weights at its own resolution; boxes get their best vehicle score."""

    size = "brought"

    def __init__(self, name: str, blueprint: Blueprint) -> None:
        super().__init__()
        self.name = name
        self.image_scale = float(blueprint.image_scale)
        self._trainable = blueprint.trainable
        # A network sees windows as large as its training images.
        side_px = blueprint.side_px or _USUAL_SIDES_PX[blueprint.kind]
        least, most = _WINDOWS_PX
        self.window_px = round(min(max(side_px / self.image_scale, least), most))
        # The libraries draw weights, which must not change the program's own draws.
        with torch.random.fork_rng(devices=[]):
            self.network = _network(blueprint, side_px)
        self.suppression_iou = self.network.suppression_iou
        self.in_windows_alone = self.network.in_windows_alone
        # The background of Faster R-CNN is its class 0.
        first = int(isinstance(self.network, FasterRcnnDetector))
        own = set(blueprint.vehicle_classes)
        self._others = [each for each in range(first, len(blueprint.classes)) if each not in own]

    def of_other_classes(self) -> "ImportedDetector | None":
        """See `Detector.of_other_classes`; the weights are shared."""
        if not self._others:
            return None
        network: Any = copy.copy(self.network)
        network.vehicle_classes = type(network.vehicle_classes)(self._others)
        others = copy.copy(self)
        # Copies of modules share the table of their parts.
        others._modules = {"network": network}
        return others

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """The network's own loss per image, normalised (section 3.2); boxes in `images`' pixels.

        Any vehicle class is right for a vehicle. Nothing is learnt about other classes.
        """
        check_targets(images, targets)
        if any(map(len, targets)) and not self._trainable:
            raise ConfigurationError(
                f"{self.name} finds turned boxes or is a YOLOv5 of 2020, which skyproof cannot "
                "train; train it where it came from."
            )
        ratio = self._ratio(images)
        with self._seeing(images) as scaled:
            return self.network.loss(scaled, [boxes / ratio.to(boxes) for boxes in targets])

    def candidates(self, images: Images) -> Candidates:
        """See `TrainableDetector.candidates`; boxes in pixels of `images`."""
        with self._seeing(images) as scaled:
            found = self.network.candidates(scaled)
        ratio = self._ratio(images).to(found.boxes)
        return Candidates(found.boxes * ratio, found.scores)

    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; the features are those at the network's resolution."""
        with self._seeing(images) as scaled:
            return self.network.pyramid(scaled)

    def size_px(self, images: Tensor) -> tuple[int, int]:
        """Height and width of images at the network's resolution."""
        height, width = (max(1, round(side * self.image_scale)) for side in images.shape[-2:])
        return height, width

    def _ratio(self, images: Tensor) -> Tensor:
        """Returns the factors from the network's pixels to those of `images`, for xyxy boxes."""
        height, width = self.size_px(images)
        return torch.tensor([images.shape[-1] / width, images.shape[-2] / height]).repeat(2)

    @contextmanager
    def _seeing(self, images: Tensor) -> Iterator[Tensor]:
        """Yields images at the network's resolution; network errors become one sentence."""
        scaled = self._scaled(images)
        try:
            yield scaled
        except (RuntimeError, ValueError, IndexError) as error:
            # Memory that is full tells nothing about the network.
            if isinstance(error, torch.OutOfMemoryError) or is_full_memory(error):
                raise
            height, width = scaled.shape[-2:]
            raise ConfigurationError(
                f"The network of {self.name} cannot see images of {width} x {height} px "
                f"({' '.join(str(error).split())[:200].rstrip('.')}); give larger tiles, or a "
                "detector for images of such sizes."
            ) from error

    def _scaled(self, images: Tensor) -> Tensor:
        check_images(images)
        height, width = self.size_px(images)
        if max(height, width) > _LARGEST_SIDE_PX:
            raise ConfigurationError(
                f"{self.name} would see images of {width} x {height} px, {self.image_scale:g} times"
                f" as large as given, and at most {_LARGEST_SIDE_PX} px a side are computed; give "
                "images near the resolution that it was made for."
            )
        if (height, width) != tuple(images.shape[-2:]):
            images = functional.interpolate(
                images, size=(height, width), mode="bilinear", align_corners=False, antialias=True
            )
        # A small image at a coarse resolution may be too small for the network.
        return pad_to_stride(images, PADDING_GREY, stride_px=1, least_px=SMALLEST_IMAGE_PX)


def _network(
    blueprint: Blueprint, side_px: int
) -> TorchvisionDetector | YoloNetwork | AnchorDetector | QueryDetector:
    if blueprint.kind == "transformers":
        return TransformersNetwork(blueprint, side_px)
    if isinstance(blueprint.architecture, dict):
        # The checkpoint lists class names; its architecture decides how many the head has.
        network: YoloNetwork | AnchorDetector | RtDetrNetwork
        if blueprint.architecture["head"][-1][2] == QUERIES:
            network = RtDetrNetwork(blueprint, side_px)
            known = network.classes
        elif "anchors" in blueprint.architecture:
            known = int(blueprint.architecture.get("nc", 0))
            network = AnchorDetector(blueprint.architecture, blueprint.vehicle_classes)
        else:
            network = YoloNetwork(blueprint.architecture, blueprint.vehicle_classes)
            known = int(network.model.model[-1].nc)
        if max(blueprint.vehicle_classes) >= known:
            raise ConfigurationError(
                f"the vehicle class {max(blueprint.vehicle_classes)} is not among the {known} that "
                "the network tells apart; give a checkpoint as Ultralytics saves it."
            )
        return network
    # `TorchvisionDetector` keeps torchvision's models from resizing.
    model = _torchvision_model(blueprint.architecture, len(blueprint.classes))
    for layer in model.backbone.modules():
        if blueprint.norm_eps is not None and isinstance(layer, nn.BatchNorm2d):
            layer.eps = blueprint.norm_eps
    family, _, _ = _FAMILIES[blueprint.architecture.partition("_")[0]]
    return family(model, tuple(blueprint.vehicle_classes), blueprint.normalised is not False)


def _torchvision_model(architecture: str, classes: int) -> Any:
    """Builds torchvision's network; of Mask R-CNN only the part that finds boxes."""
    architecture = architecture.replace("maskrcnn", "fasterrcnn")
    if hasattr(detection, architecture):
        build = getattr(detection, architecture)
        return build(weights=None, weights_backbone=None, num_classes=classes)
    family, backbone, _ = architecture.split("_")
    build = partial(
        resnet_fpn_backbone, backbone_name=backbone, weights=None, norm_layer=nn.BatchNorm2d
    )
    if family == "fasterrcnn":
        return detection.FasterRCNN(build(), classes)
    # The levels are those of torchvision's RetinaNet on ResNet-50.
    pyramid = build(returned_layers=[2, 3, 4], extra_blocks=LastLevelP6P7(256, 256))
    return detection.RetinaNet(pyramid, classes)


def class_rows(architecture: str, state: Mapping[str, Tensor]) -> tuple[int, str]:
    """Returns the weights' number of classes, with Faster R-CNN's background, and a prefix.

    The names of all the network's tensors begin with the prefix: training programs wrap the
    network, and may store other tensors beside it.
    """
    if architecture not in ARCHITECTURES:
        raise ConfigurationError(
            f"--architecture expects one of {', '.join(ARCHITECTURES)}, got {architecture!r}."
        )
    _, name, anchors = _FAMILIES[architecture.partition("_")[0]]
    prefixes = [key.removesuffix(name) for key in state if f".{key}".endswith(f".{name}")]
    prefix = averaged_first(prefixes)[0] if prefixes else ""
    name = prefix + name
    rows = len(state[name]) if name in state and state[name].ndim == 1 else 0
    if not rows or rows % anchors:
        held = (
            f"{rows} class scores in {name[:100]}, not a multiple of {anchors}"
            if rows
            else f"no {name[:100]}"
        )
        raise ConfigurationError(
            f"The weights do not fit {architecture}: they hold {held}; give the --architecture "
            "they were trained as."
        )
    return rows // anchors, prefix


class _Imported(TorchvisionDetector):
    """torchvision's normalising, and the vehicle classes, whose sigmoid scores are independent."""

    def __init__(
        self, model: nn.Module, vehicle_classes: tuple[int, ...], normalised: bool = True
    ) -> None:
        TorchvisionDetector.__init__(self, "brought", model)
        self.vehicle_classes, self.normalised = vehicle_classes, normalised

    def _normalise(self, images: Tensor) -> Tensor:
        return normalize(images, MEAN, DEVIATION) if self.normalised else images

    def _outputs(self, images: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        outputs, anchors = super()._outputs(images)
        vehicles = outputs["cls_logits"][..., list(self.vehicle_classes)]
        return {**outputs, "cls_logits": vehicles}, anchors


class ImportedFasterRcnn(_Imported, FasterRcnnDetector):
    """Faster R-CNN whose loss wants every region to be background, regardless of its class."""


class _ImportedRetinaNet(_Imported, RetinaNetDetector):
    """A RetinaNet of which only the vehicle classes count."""


class ImportedFcos(_Imported):
    """FCOS: a vehicle's score is the root of class score times centredness, as in torchvision."""

    def _terms(
        self, target: dict[str, Tensor], own: dict[str, Tensor], anchors: Tensor
    ) -> dict[str, Tensor]:
        # The anchors of a level are squares of one size.
        _, levels = (anchors[:, 2] - anchors[:, 0]).unique_consecutive(return_counts=True)
        return self.model.compute_loss([target], own, [anchors], levels.tolist())

    def candidates(self, images: Images) -> Candidates:
        """Every point's box and score."""
        outputs, anchors = self._outputs(images)
        deltas = outputs["bbox_regression"]
        boxes = self.model.box_coder.decode(deltas, anchors.expand(len(images), -1, -1))
        # The slope of the root is infinite at 0.
        centredness = outputs["bbox_ctrness"][..., 0].sigmoid()
        product = outputs["cls_logits"].amax(dim=-1).sigmoid() * centredness
        return Candidates(boxes, product.clamp(min=1e-12).sqrt())


# torchvision's families, each with the layer that has one row per class, or one per class and each
# of nine anchors.
_FAMILIES: dict[str, tuple[type[_Imported], str, int]] = {
    "fasterrcnn": (ImportedFasterRcnn, "roi_heads.box_predictor.cls_score.bias", 1),
    "maskrcnn": (ImportedFasterRcnn, "roi_heads.box_predictor.cls_score.bias", 1),
    "fcos": (ImportedFcos, "head.classification_head.cls_logits.bias", 1),
    "retinanet": (_ImportedRetinaNet, "head.classification_head.cls_logits.bias", 9),
}
