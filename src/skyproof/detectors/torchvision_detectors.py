"""RetinaNet and Faster R-CNN of torchvision, with losses per image over all negatives."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence
from torchvision import ops
from torchvision.models.detection import (
    FCOS,
    FasterRCNN,
    RetinaNet,
    fasterrcnn_resnet50_fpn_v2,
    retinanet_resnet50_fpn_v2,
)
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.retinanet import RetinaNetHead
from torchvision.models.detection.rpn import RPNHead, concat_box_prediction_layers

from skyproof.detectors.detector import (
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)
from skyproof.detectors.region_align import CentreAlign

# Bounding boxes of a 36x15 px vehicle: 36x15 along an axis (side ratio 2.4), 36x36 across the
# diagonal.
SLIM_SIDES_PX = ((20.0, 30.0), (28.0, 42.0))
SLIM_RATIOS = (0.45, 1.0, 2.2)
# torchvision's full models start at 32 px, too coarse for 15 px wide vehicles: half of its sizes,
# same count.
FULL_SIDES_PX = (16.0, 32.0, 64.0, 128.0, 256.0)
FULL_RATIOS = (0.5, 1.0, 2.0)
# Measured: anchors a vehicle makes positive in RetinaNet (slim 8.8, full 7.8). With an empty truth
# the focal sum is divided by it, so that a detected vehicle costs about one.
POSITIVES_PER_VEHICLE = 8.0
# In Faster R-CNN's proposal network more anchors find a vehicle, and cross-entropy does
# not saturate: the sum is about 60 per vehicle for the trained slim detector.
_EMPTY_PROPOSAL_DIVISOR = 64.0
PRIOR_PROBABILITY = 0.01
PROPOSALS = {"slim": 100, "full": 300}
# Channels of the slim feature pyramid and of the heads on it; a multiple of 8.
_PYRAMID_CHANNELS = 64
# Numbers in each hidden layer of the slim Faster R-CNN's region head.
_REGION_CHANNELS = 192


class TorchvisionDetector(TrainableDetector):
    """Normalises, pads and makes anchors without torchvision's silently resizing transform."""

    def __init__(self, size: str, model: RetinaNet | FasterRCNN | FCOS) -> None:
        super().__init__()
        self.size = size
        self.model = model
        # The model's transform would silently resize; without it, a direct call fails loudly.
        self.model.transform = nn.Identity()

    def _features(self, images: Tensor) -> tuple[dict[str, Tensor], ImageList]:
        check_images(images)
        # Zero is the mean grey after normalising, so zero padding adds no edge brighter than the
        # image.
        padded = pad_to_stride(self._normalise(images), value=0.0)
        sizes = [(images.shape[-2], images.shape[-1])] * len(images)
        return self.model.backbone(padded), ImageList(padded, sizes)

    def _normalise(self, images: Tensor) -> Tensor:
        return (images - 0.45) / 0.25

    def _outputs(self, images: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Returns the outputs of a one-stage network's head for every anchor, and the anchors."""
        named, image_list = self._features(images)
        features = list(named.values())
        # Images of one batch share their size and therefore their anchors.
        return self.model.head(features), self.model.anchor_generator(image_list, features)[0]

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """torchvision's own losses of a one-stage network per image, over all anchors.

        Each is divided by its image's positive anchors. With an empty truth torchvision does not
        divide the focal sum; here it is divided by the positives of a single vehicle. Where a
        network tells several vehicle classes apart, the likeliest of each anchor is the right one.
        """
        check_targets(images, targets)
        outputs, anchors = self._outputs(images)
        losses: list[Any] = []
        for index, boxes in enumerate(targets):
            own = {key: value[index : index + 1] for key, value in outputs.items()}
            divisor = POSITIVES_PER_VEHICLE
            if len(boxes):
                own["cls_logits"] = own["cls_logits"].amax(dim=-1, keepdim=True)
                divisor = 1.0
            # These networks keep no background class, so the label of the one class is 0.
            target = {"boxes": boxes, "labels": boxes.new_zeros(len(boxes), dtype=torch.int64)}
            losses.append(sum(self._terms(target, own, anchors).values()) / divisor)
        return torch.stack(losses)

    def _terms(
        self, target: dict[str, Tensor], own: dict[str, Tensor], anchors: Tensor
    ) -> dict[str, Tensor]:
        """torchvision's losses of one image."""
        return self.model.compute_loss([target], own, [anchors])

    @torch.no_grad()
    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        named, image_list = self._features(images)
        return list(named.values()), image_list.tensors.shape[-1]


class RetinaNetDetector(TorchvisionDetector):
    """torchvision's RetinaNet for one class, never resizing (section 5.3).

    Size "slim" has two pyramid levels, strides 8 and 16; "full" is a ResNet-50 FPN v2 from scratch.
    """

    name = "retinanet"

    def __init__(self, size: str) -> None:
        super().__init__(size, _build_retinanet(size))

    def candidates(self, images: Images) -> Candidates:
        """Every anchor's decoded box, with the best sigmoid score among its classes."""
        outputs, anchors = self._outputs(images)
        deltas = outputs["bbox_regression"]
        boxes = self.model.box_coder.decode(deltas, [anchors] * len(images))
        scores = outputs["cls_logits"].amax(dim=-1).sigmoid()
        return Candidates(boxes.view_as(deltas), scores)


class FasterRcnnDetector(TorchvisionDetector):
    """torchvision's Faster R-CNN for one class, never resizing, without random draws (section 5.3).

    Size "slim" has two pyramid levels, strides 8 and 16; "full" is a ResNet-50 FPN v2 from scratch.

    Differences from torchvision: all anchors and regions count instead of a random sample. The
    proposal network's sums are divided by its positive anchors (as RetinaNet's are; by a constant
    with an empty truth), because a mean over all anchors would drown the vehicles; the regions'
    cross-entropy is the mean over all proposals.
    """

    name = "faster_rcnn"
    # Columns of the region scores that are vehicles; 0 is the background.
    vehicle_classes: tuple[int, ...] = (1,)

    def __init__(self, size: str) -> None:
        super().__init__(size, _build_faster_rcnn(size))

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """Proposal loss plus region loss per image, deterministic (section 3.2).

        Where a network tells several vehicle classes apart, the likeliest of each region is the
        right one.
        """
        check_targets(images, targets)
        features, image_list = self._features(images)
        objectness, deltas, anchors, proposals = self._proposal_outputs(features, image_list)
        # As in torchvision the true boxes join the proposals, so that regions learn before
        # proposals are good.
        regions = [torch.cat([own, boxes]) for own, boxes in zip(proposals, targets, strict=True)]
        logits, region_deltas = self._region_outputs(features, regions, image_list)
        counts = [len(own) for own in regions]
        losses = []
        for index, (image_logits, image_deltas) in enumerate(
            zip(logits.split(counts), region_deltas.split(counts), strict=True)
        ):
            truth = targets[index]
            proposal_loss = self._proposal_loss(objectness[index], deltas[index], anchors, truth)
            region_loss = self._region_loss(image_logits, image_deltas, regions[index], truth)
            total = proposal_loss + region_loss
            if not len(truth):
                # PyTorch's loss subtracts numbers as large as a logit: rounding would turn the tiny
                # loss of an image that is clearly empty into exactly 0.
                sure = _cost_of_the_sure(objectness[index], image_logits)
                total = torch.where(total > 0, total, sure)
            losses.append(total)
        return torch.stack(losses)

    def candidates(self, images: Images) -> Candidates:
        """Returns every proposal's box and best vehicle score; padding rows have a score of 0."""
        features, image_list = self._features(images)
        *_, proposals = self._proposal_outputs(features, image_list)
        logits, region_deltas = self._region_outputs(features, proposals, image_list)
        counts = [len(own) for own in proposals]
        scores, columns = self._best_vehicle_class(logits)
        # Without any region torchvision leaves the classes' boxes in one row.
        decoded = self.model.roi_heads.box_coder.decode(region_deltas, proposals).view(
            len(columns), logits.shape[1], 4
        )
        boxes = decoded[torch.arange(len(columns), device=columns.device), columns]
        padded = (pad_sequence(each.split(counts), batch_first=True) for each in (boxes, scores))
        return Candidates(*padded)

    def _proposal_outputs(
        self, named: dict[str, Tensor], image_list: ImageList
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Objectness `[B, A]`, deltas `[B, A, 4]`, anchors `[A, 4]`, and each image's proposals."""
        network = self.model.rpn
        features = list(named.values())
        per_level = network.head(features)
        anchors = network.anchor_generator(image_list, features)[0]
        level_sizes = [level[0].numel() for level in per_level[0]]
        objectness, deltas = concat_box_prediction_layers(*per_level)
        batch = len(image_list.image_sizes)
        objectness = objectness.view(batch, -1)
        deltas = deltas.view(batch, -1, 4)
        # As in torchvision no gradient flows through the places of the proposals.
        boxes = network.box_coder.decode(deltas.detach(), [anchors] * batch)
        proposals, _ = network.filter_proposals(
            boxes.view_as(deltas), objectness, image_list.image_sizes, level_sizes
        )
        return objectness, deltas, anchors, proposals

    def _region_outputs(
        self, named: dict[str, Tensor], regions: list[Tensor], image_list: ImageList
    ) -> tuple[Tensor, Tensor]:
        # The names tell the head which levels to read: all but the proposals' coarsest.
        heads = self.model.roi_heads
        return heads.box_predictor(
            heads.box_head(heads.box_roi_pool(named, regions, image_list.image_sizes))
        )

    def _proposal_loss(
        self, objectness: Tensor, deltas: Tensor, anchors: Tensor, truth: Tensor
    ) -> Tensor:
        network = self.model.rpn
        labels, matched = network.assign_targets_to_anchors([anchors], [{"boxes": truth}])
        counted, positive = labels[0] >= 0, labels[0] > 0
        entropy = functional.binary_cross_entropy_with_logits(
            objectness[counted], labels[0][counted], reduction="sum"
        )
        if not len(truth):
            return entropy / _EMPTY_PROPOSAL_DIVISOR
        divisor = positive.sum().clamp(min=POSITIVES_PER_VEHICLE)
        wanted = network.box_coder.encode_single(matched[0][positive], anchors[positive])
        return (
            entropy
            + functional.smooth_l1_loss(deltas[positive], wanted, beta=1 / 9, reduction="sum")
        ) / divisor

    def _region_loss(
        self, logits: Tensor, deltas: Tensor, regions: Tensor, truth: Tensor
    ) -> Tensor:
        if not len(regions):
            # A mean over no region would not be finite.
            return logits.sum()
        heads = self.model.roi_heads
        ones = torch.ones(len(truth), dtype=torch.int64, device=truth.device)
        matched, labels = heads.assign_targets_to_proposals([regions], [truth], [ones])
        _, columns = self._best_vehicle_class(logits)
        positive = labels[0] > 0
        entropy = functional.cross_entropy(logits, torch.where(positive, columns, labels[0]))
        if not len(truth):
            return entropy
        wanted = heads.box_coder.encode_single(truth[matched[0][positive]], regions[positive])
        # Every class has a box of its own.
        given = deltas.view(len(deltas), -1, 4)[positive, columns[positive]]
        box = functional.smooth_l1_loss(given, wanted, beta=1 / 9, reduction="sum")
        return entropy + box / len(regions)

    def _best_vehicle_class(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        """Every region's score of its likeliest vehicle class, and that class's column."""
        scores, best = logits.softmax(dim=1)[:, list(self.vehicle_classes)].max(dim=1)
        return scores, torch.tensor(self.vehicle_classes, device=best.device)[best]


def _cost_of_the_sure(objectness: Tensor, logits: Tensor) -> Tensor:
    """Returns the loss for an empty truth in a form that stays exact, above 0, at low scores."""
    cost = functional.softplus(objectness).sum() / _EMPTY_PROPOSAL_DIVISOR
    if len(logits):
        doubt = logits[:, 1:].logsumexp(dim=1) - logits[:, 0]
        cost = cost + functional.softplus(doubt).mean()
    return cost


def _build_retinanet(size: str) -> RetinaNet:
    if size == "full":
        model = retinanet_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=1)
        thirds = tuple(tuple(side * 2 ** (step / 3) for step in range(3)) for side in FULL_SIDES_PX)
        model.anchor_generator = AnchorGenerator(thirds, (FULL_RATIOS,) * len(thirds))
        return model
    anchors = AnchorGenerator(SLIM_SIDES_PX, (SLIM_RATIOS,) * len(SLIM_SIDES_PX))
    # This comes before the backbone: the order decides the initial weights of a seed.
    head = RetinaNetHead(
        _PYRAMID_CHANNELS,
        anchors.num_anchors_per_location()[0],
        1,
        norm_layer=partial(nn.GroupNorm, 8),
    )
    for branch in (head.classification_head, head.regression_head):
        # Two of torchvision's four convolutions are enough for one class and halve the time.
        branch.conv = branch.conv[:2]
    return RetinaNet(_SlimBackbone(), num_classes=1, anchor_generator=anchors, head=head)


def _build_faster_rcnn(size: str) -> FasterRCNN:
    limits = {
        f"rpn_{stage}_nms_top_n_{mode}": times * PROPOSALS[size]
        for mode in ("train", "test")
        for stage, times in (("pre", 3), ("post", 1))
    }
    if size == "full":
        model = fasterrcnn_resnet50_fpn_v2(
            weights=None, weights_backbone=None, num_classes=2, **limits
        )
        model.rpn.anchor_generator = AnchorGenerator(
            tuple((side,) for side in FULL_SIDES_PX), (FULL_RATIOS,) * len(FULL_SIDES_PX)
        )
    else:
        anchors = AnchorGenerator(SLIM_SIDES_PX, (SLIM_RATIOS,) * len(SLIM_SIDES_PX))
        model = FasterRCNN(
            _SlimBackbone(),
            rpn_anchor_generator=anchors,
            rpn_head=RPNHead(_PYRAMID_CHANNELS, anchors.num_anchors_per_location()[0]),
            rpn_fg_iou_thresh=0.6,
            # A bin of a 36 px region is smaller than a stride of 8 px, so one sample is enough.
            box_roi_pool=CentreAlign((8.0, 16.0), output_size=5),
            box_head=TwoMLPHead(_PYRAMID_CHANNELS * 5 * 5, _REGION_CHANNELS),
            box_predictor=FastRCNNPredictor(_REGION_CHANNELS, 2),
            **limits,
        )
        for layer in model.rpn.head.conv.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    # All negatives count from the first step, so they must start as improbable as in RetinaNet.
    nn.init.constant_(
        model.rpn.head.cls_logits.bias, -math.log((1 - PRIOR_PROBABILITY) / PRIOR_PROBABILITY)
    )
    return model


class _Residual(nn.Module):
    """Two 3x3 convolutions beside the identity; the second starts at zero, for easy training."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = ops.Conv2dNormActivation(channels, channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.normalise = nn.BatchNorm2d(channels)
        nn.init.zeros_(self.normalise.weight)

    def forward(self, features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        return functional.relu(features + self.normalise(self.second(self.first(features))))


class _SlimBackbone(nn.Module):
    """Four stages with a pyramid at strides 8 and 16; at 32 a vehicle of 36x15 px would vanish."""

    def __init__(self) -> None:
        super().__init__()
        # Channels at strides 2, 4, 8 and 16.
        first, second, third, fourth = 24, 48, 96, 128
        self.out_channels = _PYRAMID_CHANNELS
        self.to_stride_4 = nn.Sequential(
            ops.Conv2dNormActivation(3, first, stride=2),
            ops.Conv2dNormActivation(first, second, stride=2),
            _Residual(second),
        )
        self.to_stride_8 = nn.Sequential(
            ops.Conv2dNormActivation(second, third, stride=2), _Residual(third)
        )
        self.to_stride_16 = nn.Sequential(
            ops.Conv2dNormActivation(third, fourth, stride=2), _Residual(fourth)
        )
        self.pyramid = ops.FeaturePyramidNetwork([third, fourth], _PYRAMID_CHANNELS)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> OrderedDict[str, Tensor]:
        stride_8 = self.to_stride_8(self.to_stride_4(images))
        return self.pyramid(OrderedDict([("0", stride_8), ("1", self.to_stride_16(stride_8))]))
