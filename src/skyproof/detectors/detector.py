"""The interface of a detector, and the checks, and the padding that all of them share."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torchvision import ops

from skyproof.detectors.card import DetectorCard
from skyproof.errors import ConfigurationError
from skyproof.storage import weights_digest

Images = Float[Tensor, "B 3 H W"]
"""sRGB images in [0, 1]."""

Boxes = Float[Tensor, "_ 4"]
"""Pixel xyxy, half-open, origin at the top-left corner."""

SMALLEST_IMAGE_PX = 96
PADDING_GREY = 0.45
LOWEST_SCORE = 0.01
WINDOW_PX = 384
"""The paper's tile: a window of 48 m holds at most 100 vehicles."""
# Limits for one window, as in torchvision: an attacked window may have thousands of candidates
# above the lowest score.
_MOST_DETECTIONS, _MOST_CANDIDATES = 100, 1000
SUPPRESSION_IOU = 0.5


@dataclass(frozen=True)
class Detections:
    """The detections in one image: `Boxes`, sorted by falling score, and scores in [0, 1]."""

    boxes: Float[Tensor, "K 4"]
    scores: Float[Tensor, " K"]


@dataclass(frozen=True)
class Candidates:
    """Boxes (pixel xyxy) and scores in [0, 1] before suppression; padding has a score of 0."""

    boxes: Float[Tensor, "B K 4"]
    scores: Float[Tensor, "B K"]


class Detector:
    """A detector with its card: it finds vehicles, and the card says what its scores mean.

    The detector scales and normalises images itself.

    Attributes:
        name: name in tables and file names.
        card: frozen threshold, resolution and origin; not set before a threshold is frozen.
        window_px: side of the windows into which a large image is split.
        in_windows_alone: whether any image beyond such a window is large.
    """

    name: str
    card: DetectorCard
    window_px: int = WINDOW_PX
    in_windows_alone: bool = False

    def detect(self, images: Images) -> list[Detections]:
        """Finds vehicles in sRGB images in [0, 1]: all with score >= 0.01, after suppression."""
        raise NotImplementedError

    def of_other_classes(self) -> "Detector | None":
        """Returns this detector for the classes that are not vehicles; None if it knows none."""
        return None

    @property
    def threshold(self) -> float:
        """The frozen score at or above which a detection counts."""
        return self.card.threshold

    @property
    def weights_sha256(self) -> str:
        """Digest of the weights in use; empty for a black-box detector."""
        return ""

    def set_card(self, card: DetectorCard) -> None:
        """Gives the detector a card, and its name with it."""
        self.name = card.name
        self.card = card


class TrainableDetector(nn.Module, Detector):
    """A detector with its own loss, which can be trained and attacked.

    Of two boxes that overlap by more than `suppression_iou` the better one stays.
    """

    size: str
    suppression_iou: float = SUPPRESSION_IOU

    @property
    def weights_sha256(self) -> str:
        """Digest of parameters and buffers; an attack leaves it unchanged."""
        return weights_digest(self)

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """The detector's own training loss per image, normalised (section 3.2).

        Each value depends on its image alone; all negatives count; with an empty truth (`[0, 4]`)
        it is finite, positive and of order 1 or below. Differentiable in `images` (sRGB in [0, 1])
        and in the weights. Targets are pixel xyxy.
        """
        raise NotImplementedError

    def candidates(self, images: Images) -> Candidates:
        """Boxes and scores before threshold and suppression, differentiable in `images`."""
        raise NotImplementedError

    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """The features before any head, the finest level first, and the padded images' width."""
        raise NotImplementedError

    @torch.no_grad()
    def detect(self, images: Images) -> list[Detections]:
        """Clips candidates to the image; keeps the best without overlap, at most 100 per window."""
        height_px, width_px = images.shape[-2:]
        windows = max(1, height_px * width_px // WINDOW_PX**2)
        candidates = self.candidates(images)
        found = []
        for boxes, scores in zip(candidates.boxes, candidates.scores, strict=True):
            clipped = ops.clip_boxes_to_image(boxes, (height_px, width_px))
            sides = clipped[:, 2:] - clipped[:, :2]
            keep = (scores >= LOWEST_SCORE) & (sides > 0.5).all(dim=1)
            ordered, order = scores[keep].sort(descending=True, stable=True)
            kept_scores = ordered[: windows * _MOST_CANDIDATES]
            kept_boxes = clipped[keep][order[: windows * _MOST_CANDIDATES]]
            best = ops.nms(kept_boxes, kept_scores, self.suppression_iou)
            best = best[: windows * _MOST_DETECTIONS]
            found.append(Detections(kept_boxes[best], kept_scores[best].clamp(0, 1)))
        return found


def check_images(images: Tensor) -> None:
    """Refuses images that no detector here can read."""
    if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[-2:]) < SMALLEST_IMAGE_PX:
        raise ConfigurationError(
            "A detector expects images [B, 3, H, W] with H and W of at least "
            f"{SMALLEST_IMAGE_PX} px, but got {list(images.shape)}; use larger tiles."
        )


def check_targets(images: Tensor, targets: Sequence[Tensor]) -> None:
    """Refuses targets without one box tensor per image."""
    if len(targets) != len(images):
        raise ConfigurationError(
            f"A loss expects one tensor of boxes per image, but got {len(targets)} for "
            f"{len(images)}."
        )


def pad_to_stride(
    images: Float[Tensor, "B 3 H W"], value: float, stride_px: int = 32, least_px: int = 0
) -> Float[Tensor, "B 3 H2 W2"]:
    """Pads right and below to the next multiples of `stride_px` from `least_px`; boxes stay."""
    below, right = (
        math.ceil(max(side, least_px) / stride_px) * stride_px - side for side in images.shape[-2:]
    )
    return functional.pad(images, (0, right, 0, below), value=value)
