"""What transformer detectors share, of whichever library: queries that answer with a box each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torchvision.ops import box_convert, box_iou
from torchvision.transforms.functional import normalize

from skyproof.detectors.detector import (
    PADDING_GREY,
    Boxes,
    Candidates,
    Images,
    TrainableDetector,
    check_images,
    check_targets,
    pad_to_stride,
)


@dataclass(frozen=True)
class Answers:
    """Class scores before sigmoid or softmax; boxes as centre and sides, in shares of the image."""

    logits: Float[Tensor, "B Q C"]
    boxes: Float[Tensor, "B Q 4"]


class QueryDetector(TrainableDetector):
    """A DETR, RT-DETR or relative: each query answers with one box and a score of each class.

    Boxes are shares of the image's sides, so smaller images are padded to `side_px`, the side in
    training, and larger ones are split. Answers are not suppressed. Dropout always stays off.
    """

    model: Any
    suppression_iou = 1.0
    in_windows_alone = True
    focal_weight, focal_exponent = 0.75, 2.0
    """Weight and exponent of a score in the library's loss of a query without a vehicle."""
    stride_px = 32
    """Sides of the network's images are multiples of it."""
    colours: tuple[Sequence[float], Sequence[float]] = ((0.0,) * 3, (1.0,) * 3)
    """Mean and deviation by which the network's images are normalised."""

    def __init__(self, vehicle_classes: Sequence[int], classes: int, side_px: int) -> None:
        super().__init__()
        self.vehicle_classes = list(vehicle_classes)
        self.classes = classes
        self.side_px = side_px

    def answers(self, seen: Tensor) -> Answers:
        """The network's answers to normalised images, with gradients through all its parts."""
        raise NotImplementedError

    def cost(self, seen: Tensor, classes: Tensor, boxes: Tensor) -> Tensor:
        """The library's own loss of one image with vehicles, whose boxes are as in `Answers`."""
        raise NotImplementedError

    def features(self, seen: Tensor) -> list[Tensor]:
        """The features of the backbone, the finest level first."""
        raise NotImplementedError

    def train(self, mode: bool = True) -> "QueryDetector":
        """Keeps the network as it infers: without dropout or denoising queries."""
        return super().train(False)

    def candidates(self, images: Images) -> Candidates:
        """Every query's box and its score of the likeliest vehicle class."""
        seen, sides = self._seen(images)
        found = self.answers(seen)
        boxes = box_convert(found.boxes, "cxcywh", "xyxy") * sides
        nothing = self._tells_nothing(found.logits)
        scores = found.logits.softmax(dim=-1) if nothing else found.logits.sigmoid()
        return Candidates(boxes, scores[..., self.vehicle_classes].amax(dim=-1))

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """The library's own loss of each image, and for an empty truth its part for the queries.

        With an empty truth every query of the last layer should answer "no vehicle": the focal
        term of each vehicle class, summed as the library does; for DETR, whose softmax has a class
        "nothing", minus the log of the share of the other classes, summed where the library
        averages. Where a network tells several vehicle classes apart, the likeliest one of the
        query that overlaps a vehicle most is the right one.
        """
        check_targets(images, targets)
        seen, sides = self._seen(images)
        if not any(map(len, targets)):
            return self._doubt(seen)
        losses = []
        for image, boxes in zip(seen.split(1), targets, strict=True):
            if len(boxes):
                shares = boxes.to(sides) / sides
                centred = box_convert(shares, "xyxy", "cxcywh")
                losses.append(self.cost(image, self._likeliest(image, shares), centred))
            else:
                losses.append(self._doubt(image)[0])
        return torch.stack(losses)

    @torch.no_grad()
    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; the features are those of the backbone."""
        seen, _ = self._seen(images)
        return self.features(seen), seen.shape[-1]

    def _tells_nothing(self, logits: Tensor) -> bool:
        """Whether the last class is "nothing", as in DETR."""
        return logits.shape[-1] == self.classes + 1

    def _doubt(self, seen: Tensor) -> Float[Tensor, " B"]:
        logits = self.answers(seen).logits
        vehicles = logits[..., self.vehicle_classes]
        if self._tells_nothing(logits):
            others = [each for each in range(logits.shape[-1]) if each not in self.vehicle_classes]
            odds = vehicles.logsumexp(dim=-1) - logits[..., others].logsumexp(dim=-1)
            return functional.softplus(odds).sum(dim=-1)
        weight = self.focal_weight * vehicles.sigmoid() ** self.focal_exponent
        return (weight * functional.softplus(vehicles)).sum(dim=(1, 2))

    @torch.no_grad()
    def _likeliest(self, image: Tensor, boxes: Boxes) -> Tensor:
        """Each box's vehicle class: the likeliest one of the query that overlaps it most."""
        known = torch.tensor(self.vehicle_classes, device=image.device)
        if len(known) == 1:
            return known.expand(len(boxes))
        found = self.answers(image)
        overlaps = box_iou(box_convert(found.boxes[0], "cxcywh", "xyxy"), boxes)
        return known[found.logits[0, overlaps.argmax(dim=0)][:, known].argmax(dim=1)]

    def _seen(self, images: Images) -> tuple[Tensor, Tensor]:
        """Pads right and below to the side in training, and normalises; also returns the sides."""
        check_images(images)
        padded = pad_to_stride(images, PADDING_GREY, self.stride_px, self.side_px)
        sides = images.new_tensor([padded.shape[-1], padded.shape[-2]] * 2)
        return normalize(padded, *self.colours), sides
