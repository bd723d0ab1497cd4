"""The features of a box: one vector of the detector's feature pyramid, before any head reads it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision import ops

# A vehicle of 36 px spans 4.5 cells of stride 8: one sample in each.
_SAMPLES = 4
# Lin et al. 2017, equation 1: a box of 224 px belongs to the level of stride 16.
_CANONICAL_SIDE_PX = 224
_CANONICAL_STRIDE_PX = 16

Levels = Callable[[Float[Tensor, "K 4"]], Int[Tensor, " K"]]
"""Gives the pyramid level, from 0, of each box, pixel xyxy."""


@runtime_checkable
class FeatureDetector(Protocol):
    """A detector that gives its pyramid features; a black box with `detect` alone does not."""

    def features(
        self, images: Float[Tensor, "B 3 H W"], boxes: Sequence[Float[Tensor, "_ 4"]]
    ) -> list[Float[Tensor, "_ C"]]:
        """Gives one vector per box, the mean over the box, at the pyramid level of the box.

        Images are sRGB in [0, 1], boxes pixel xyxy. The detector assigns the level.
        """
        ...


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


def area_levels(strides_px: Sequence[float]) -> Levels:
    """Chooses levels by the square root of a box's area, as Faster R-CNN does for its regions.

    The stride of each level is twice the one before.
    """

    def level_of(boxes: Tensor) -> Tensor:
        sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1).prod(dim=1).sqrt()
        # The small number is torchvision's, for boxes on a limit.
        wanted = (sides / _CANONICAL_SIDE_PX).log2() + math.log2(_CANONICAL_STRIDE_PX) + 1e-6
        first = math.log2(strides_px[0])
        return (wanted.floor() - first).clamp(0, len(strides_px) - 1).long()

    return level_of


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


def pool_finest(
    finest: Float[Tensor, "B C _ _"], stride_px: float, boxes: Sequence[Float[Tensor, "_ 4"]]
) -> list[Float[Tensor, "_ C"]]:
    """Averages the finest level of a YOLO's pyramid over each box (pixel xyxy).

    In a YOLO the size of a vehicle alone does not decide its level, and levels differ in channels.
    The finest one has points on every vehicle.
    """

    def level_of(places: Tensor) -> Tensor:
        return torch.zeros(len(places), dtype=torch.int64, device=places.device)

    return pool_boxes([finest], round(finest.shape[-1] * stride_px), boxes, level_of)
