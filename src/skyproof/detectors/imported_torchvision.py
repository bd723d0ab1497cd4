"""torchvision's detectors with imported weights, and with classes that are no vehicles."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import detection
from torchvision.ops import sigmoid_focal_loss

from skyproof.detectors.blueprint import ARCHITECTURES
from skyproof.detectors.common import check_targets
from skyproof.detectors.detector import Boxes, Candidates, Images
from skyproof.detectors.torchvision_detectors import (
    POSITIVES_PER_VEHICLE,
    FasterRcnnDetector,
    RetinaNetDetector,
    TorchvisionDetector,
)
from skyproof.errors import ConfigurationError

# The mean and deviation of torchvision's own transform.
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
# The layer with one row per class, or one per class and each of nine anchors.
_CLASS_ROWS = {
    "fasterrcnn": ("roi_heads.box_predictor.cls_score.bias", 1),
    "fcos": ("head.classification_head.cls_logits.bias", 1),
    "retinanet": ("head.classification_head.cls_logits.bias", 9),
}


def count_classes(architecture: str, state: Mapping[str, Tensor]) -> int:
    """The number of classes in the weights, Faster R-CNN's background included."""
    if architecture not in ARCHITECTURES:
        raise ConfigurationError(
            f"--architecture expects one of {', '.join(ARCHITECTURES)}, got {architecture!r}."
        )
    name, anchors = _CLASS_ROWS[architecture.partition("_")[0]]
    rows = len(state[name]) if name in state and state[name].ndim == 1 else 0
    if not rows or rows % anchors:
        held = (
            f"{rows} class scores in {name}, not a multiple of {anchors}" if rows else f"no {name}"
        )
        raise ConfigurationError(
            f"The weights do not fit {architecture}: they hold {held}; give the --architecture "
            "they were trained as."
        )
    return rows // anchors


def build_torchvision(
    architecture: str, class_count: int, vehicle_classes: Sequence[int], norm_eps: float | None
) -> TorchvisionDetector:
    """Builds the network of one of `ARCHITECTURES`, without weights; it never resizes.

    Anchors and limits are torchvision's own. `norm_eps` is the epsilon of the backbone's batch
    norm, if torchvision's published weights need another one.
    """
    model = getattr(detection, architecture)(
        weights=None, weights_backbone=None, num_classes=class_count
    )
    for layer in model.backbone.modules():
        if norm_eps is not None and isinstance(layer, nn.BatchNorm2d):
            layer.eps = norm_eps
    families = {
        "fasterrcnn": ImportedFasterRcnn,
        "fcos": ImportedFcos,
        "retinanet": ImportedRetinaNet,
    }
    return families[architecture.partition("_")[0]](model, tuple(vehicle_classes))


class _Imported(TorchvisionDetector):
    """torchvision's normalising, and the vehicle classes."""

    def __init__(self, model: nn.Module, vehicle_classes: tuple[int, ...]) -> None:
        TorchvisionDetector.__init__(self, "brought", model)
        self.vehicle_classes = vehicle_classes

    def _normalise(self, images: Tensor) -> Tensor:
        mean, deviation = (images.new_tensor(each).view(3, 1, 1) for each in (MEAN, DEVIATION))
        return (images - mean) / deviation


class ImportedFasterRcnn(_Imported, FasterRcnnDetector):
    """Faster R-CNN whose loss wants every region to be background, regardless of its class."""


class ImportedRetinaNet(_Imported, RetinaNetDetector):
    """A RetinaNet of several classes.

    Its sigmoid scores are independent, so only the vehicle classes count.
    """

    def _outputs(self, images: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        outputs, anchors = super()._outputs(images)
        vehicles = outputs["cls_logits"][..., list(self.vehicle_classes)]
        return {**outputs, "cls_logits": vehicles}, anchors


class ImportedFcos(_Imported):
    """FCOS: a vehicle's score is the root of class score times centredness, as in torchvision."""

    name = "fcos"

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """torchvision's focal loss of the vehicle classes against an empty truth.

        It is divided by the points that one vehicle gets. Centredness has no loss without a vehicle
        (section 3.2).
        """
        check_targets(images, targets)
        logits = self._outputs(images)[0]["cls_logits"]
        focal = sigmoid_focal_loss(logits, torch.zeros_like(logits))
        return focal.sum(dim=(1, 2)) / POSITIVES_PER_VEHICLE

    def candidates(self, images: Images) -> Candidates:
        """Every point's box and score."""
        outputs, anchors = self._outputs(images)
        deltas = outputs["bbox_regression"]
        boxes = self.model.box_coder.decode(deltas, anchors.expand(len(images), -1, -1))
        # The slope of the root is infinite at 0.
        product = (
            outputs["cls_logits"].amax(dim=-1).sigmoid() * outputs["bbox_ctrness"][..., 0].sigmoid()
        )
        scores = product.clamp(min=1e-12).sqrt()
        return Candidates(boxes, scores, torch.ones_like(scores, dtype=torch.bool))

    def _outputs(self, images: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        named, image_list = self._features(images)
        features = list(named.values())
        outputs = self.model.head(features)
        vehicles = outputs["cls_logits"][..., list(self.vehicle_classes)]
        return {**outputs, "cls_logits": vehicles}, self.model.anchor_generator(
            image_list, features
        )[0]
