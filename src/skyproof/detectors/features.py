"""What a detector's feature pyramid holds at a box: one vector, before any head reads it."""

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
"""Says of each box, pixel xyxy, on which level of the pyramid it is looked for, from 0."""


@runtime_checkable
class FeatureDetector(Protocol):
    """A detector that shows its feature pyramid; a black box with `detect` alone does not."""

    def features(
        self, images: Float[Tensor, "B 3 H W"], boxes: Sequence[Float[Tensor, "_ 4"]]
    ) -> list[Float[Tensor, "_ C"]]:
        """Gives the pyramid's features in boxes, each at the level that the detector gives its box.

        Args:
            images: sRGB in [0, 1].
            boxes: per image, pixel xyxy.

        Returns:
            Per image one vector for each box, the mean over the box.
        """
        ...


def pool_boxes(
    pyramid: Sequence[Float[Tensor, "B C _ _"]],
    width_px: int,
    boxes: Sequence[Float[Tensor, "_ 4"]],
    level_of: Levels,
) -> list[Float[Tensor, "_ C"]]:
    """Averages one level of a pyramid over each box, by RoIAlign.

    Args:
        pyramid: features of B images, the finest level first.
        width_px: of the images that the pyramid was made of, with their padding.
        boxes: per image, pixel xyxy.
        level_of: which level each box belongs to.
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

    Args:
        strides_px: of the levels, each twice the one before.
    """

    def level_of(boxes: Tensor) -> Tensor:
        sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1).prod(dim=1).sqrt()
        # The small number is torchvision's, for boxes on a limit.
        wanted = (sides / _CANONICAL_SIDE_PX).log2() + math.log2(_CANONICAL_STRIDE_PX) + 1e-6
        first = math.log2(strides_px[0])
        return (wanted.floor() - first).clamp(0, len(strides_px) - 1).long()

    return level_of


def anchor_levels(anchors: Sequence[Float[Tensor, "_ 4"]]) -> Levels:
    """Chooses the level with the anchor most like a box, as RetinaNet's matcher does.

    Args:
        anchors: per level, pixel xyxy around a common centre.
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
    """Averages the finest level of a YOLO's pyramid over each box.

    Which levels are to find a vehicle is not told by its size alone there, and levels differ in
    channels. On the finest one every vehicle has points.

    Args:
        finest: features of B images.
        stride_px: of that level.
        boxes: per image, pixel xyxy.
    """

    def level_of(places: Tensor) -> Tensor:
        return torch.zeros(len(places), dtype=torch.int64, device=places.device)

    return pool_boxes([finest], round(finest.shape[-1] * stride_px), boxes, level_of)
