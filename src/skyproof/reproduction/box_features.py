"""The features of a box: one vector of the detector's feature pyramid, before any head reads it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision import ops

from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.region_align import area_levels
from skyproof.detectors.torchvision_detectors import RetinaNetDetector, TorchvisionDetector

# A vehicle of 36 px spans 4.5 cells of stride 8: one sample in each.
_SAMPLES = 4

Levels = Callable[[Float[Tensor, "K 4"]], Int[Tensor, " K"]]
"""Gives the pyramid level, from 0, of each box, pixel xyxy."""


@torch.no_grad()
def box_features(
    detector: TrainableDetector,
    images: Float[Tensor, "B 3 H W"],
    boxes: Sequence[Float[Tensor, "_ 4"]],
) -> list[Float[Tensor, "_ C"]]:
    """Gives one vector per box, the mean over the box, at the pyramid level of the box.

    Images are sRGB in [0, 1], boxes pixel xyxy. In a YOLO the size of a vehicle alone does not
    decide its level, and levels differ in channels, so the finest level counts.
    """
    if isinstance(detector, ImportedDetector):
        height, width = detector.size_px(images)
        ratio = images.new_tensor([width / images.shape[-1], height / images.shape[-2]]).repeat(2)
        boxes = [own.to(images) * ratio for own in boxes]
    levels, width_px = detector.pyramid(images)
    network = detector.network if isinstance(detector, ImportedDetector) else detector
    if isinstance(network, RetinaNetDetector):
        anchors = network.model.anchor_generator.cell_anchors
        return pool_boxes(levels, width_px, boxes, anchor_levels(anchors))
    if isinstance(network, TorchvisionDetector):
        strides_px = [width_px / level.shape[-1] for level in levels]
        return pool_boxes(levels, width_px, boxes, lambda own: area_levels(own, strides_px))
    return pool_boxes(levels[:1], width_px, boxes, lambda own: own[:, 0].long() * 0)


def pool_boxes(
    pyramid: Sequence[Float[Tensor, "B C _ _"]],
    width_px: int,
    boxes: Sequence[Float[Tensor, "_ 4"]],
    level_of: Levels,
) -> list[Float[Tensor, "_ C"]]:
    """Averages the level that `level_of` chooses over each box (pixel xyxy), by RoIAlign.

    The finest level of the pyramid comes first; `width_px` is that of its padded input images.
    """
    places = torch.cat(
        [
            torch.cat([own.new_full((len(own), 1), index), own], dim=1)
            for index, own in enumerate(boxes)
        ]
    ).to(pyramid[0])
    levels = level_of(places[:, 1:])
    pooled = pyramid[0].new_zeros(len(places), pyramid[0].shape[1])
    for number, features in enumerate(pyramid):
        chosen = levels == number
        if chosen.any():
            scale = features.shape[-1] / width_px
            means = ops.roi_align(features, places[chosen], 1, scale, _SAMPLES, aligned=True)
            pooled[chosen] = means.flatten(1)
    return list(pooled.split([len(own) for own in boxes]))


def anchor_levels(anchors: Sequence[Float[Tensor, "_ 4"]]) -> Levels:
    """Chooses the level whose anchor is most like a box, as RetinaNet's matcher does.

    The anchors are those of each level, pixel xyxy around a common centre.
    """

    def level_of(boxes: Tensor) -> Tensor:
        halves = (boxes[:, 2:] - boxes[:, :2]) / 2
        centred = torch.cat([-halves, halves], dim=1)
        overlaps = [ops.box_iou(centred, own.to(centred)).amax(dim=1) for own in anchors]
        return torch.stack(overlaps).argmax(dim=0)

    return level_of
