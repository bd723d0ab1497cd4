"""A detector from elsewhere, at its own resolution, as one that can be evaluated and attacked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from skyproof.detectors.common import (
    PADDING_GREY,
    SMALLEST_IMAGE_PX,
    check_images,
    check_targets,
    suppress,
)
from skyproof.detectors.detector import Candidates, Detections, TrainableDetector
from skyproof.detectors.imported_torchvision import ARCHITECTURES, build_torchvision
from skyproof.detectors.torchvision_detectors import TorchvisionDetector
from skyproof.detectors.ultralytics_detectors import YoloNetwork, check_layers
from skyproof.errors import ConfigurationError

__all__ = ["Blueprint", "ImportedDetector"]


@dataclass(frozen=True)
class Blueprint:
    """What builds an imported detector's network, but for the weights.

    Its plain values are kept in `detector.json`.

    Attributes:
        kind: "torchvision" or "ultralytics".
        architecture: torchvision's name of it, or Ultralytics' YAML of it.
        classes: all class names of the checkpoint in their order; of torchvision's, which has none,
            "0", "1", ...
        vehicle_classes: which of them are vehicles, by position.
        image_scale: the network's pixels per pixel of the images it is given, 1 where they have its
            resolution.
        norm_eps: of torchvision's published weights, where their batch norm has another one; None
            else.
        checkpoint: name of the file it came from.
        checkpoint_sha256: of that file.

    Raises:
        ConfigurationError: a value that no network can be built from.
    """

    kind: str
    architecture: Any
    classes: Sequence[str]
    vehicle_classes: Sequence[int]
    image_scale: float
    norm_eps: float | None
    checkpoint: str
    checkpoint_sha256: str

    def __post_init__(self) -> None:
        if self.kind == "ultralytics":
            check_layers(self.architecture)
        elif self.kind != "torchvision" or self.architecture not in ARCHITECTURES:
            raise ConfigurationError(
                f"no detector of kind {self.kind!r} is called {self.architecture!r}."
            )
        if not self.vehicle_classes or not all(
            0 <= index < len(self.classes) for index in self.vehicle_classes
        ):
            raise ConfigurationError(
                f"vehicle classes {self.vehicle_classes} are not among {len(self.classes)}."
            )
        if not 0.05 <= self.image_scale <= 20:
            raise ConfigurationError(
                f"a scale of {self.image_scale:g} between two resolutions is out of reason."
            )


class ImportedDetector(TrainableDetector):
    """A network with another's weights: frozen, attacked through its loss against an empty truth.

    Images are brought to the network's resolution with anti-aliasing, boxes back to that of the
    images. Scores are of the best vehicle class, and suppression runs over all vehicle classes
    together.

    Args:
        name: as tables show it.
        blueprint: what builds the network.

    Raises:
        ConfigurationError: Ultralytics is wanted and not installed.
    """

    size = "brought"

    def __init__(self, name: str, blueprint: Blueprint) -> None:
        super().__init__()
        self.name = name
        self.image_scale = float(blueprint.image_scale)
        # The libraries draw weights, which are replaced at once: the program's own draws must not
        # notice.
        with torch.random.fork_rng(devices=[]):
            self.network = _network(blueprint)

    def loss(
        self, images: Float[Tensor, "B 3 H W"], targets: Sequence[Float[Tensor, "_ 4"]]
    ) -> Float[Tensor, " B"]:
        """The network's own loss per image against an empty truth, normalised (section 3.2).

        Raises:
            ConfigurationError: a vehicle among the targets: an imported detector is not trained
                here.
        """
        check_targets(images, targets)
        if any(len(boxes) for boxes in targets):
            raise ConfigurationError(
                f"{self.name} was imported and is not trained here: its loss knows no vehicles."
            )
        return self.network.loss(self._scaled(images), targets)

    def candidates(self, images: Float[Tensor, "B 3 H W"]) -> Candidates:
        """See `TrainableDetector.candidates`; boxes in pixels of `images`."""
        found = self.network.candidates(self._scaled(images))
        height, width = self._size_px(images)
        ratio = found.boxes.new_tensor(
            [images.shape[-1] / width, images.shape[-2] / height]
        ).repeat(2)
        return Candidates(found.boxes * ratio, found.scores, found.valid)

    @torch.no_grad()
    def detect(self, images: Float[Tensor, "B 3 H W"]) -> list[Detections]:
        """See `Detector.detect`."""
        return suppress(self.candidates(images), images.shape[-2], images.shape[-1])

    def _size_px(self, images: Tensor) -> tuple[int, int]:
        return max(1, round(images.shape[-2] * self.image_scale)), max(
            1, round(images.shape[-1] * self.image_scale)
        )

    def _scaled(self, images: Tensor) -> Tensor:
        check_images(images)
        height, width = self._size_px(images)
        if (height, width) != tuple(images.shape[-2:]):
            images = functional.interpolate(
                images, size=(height, width), mode="bilinear", align_corners=False, antialias=True
            )
        # A small image at a coarse resolution may fall below what networks read.
        margins = (0, max(0, SMALLEST_IMAGE_PX - width), 0, max(0, SMALLEST_IMAGE_PX - height))
        return functional.pad(images, margins, value=PADDING_GREY) if any(margins) else images


def _network(blueprint: Blueprint) -> TorchvisionDetector | YoloNetwork:
    if blueprint.kind == "ultralytics":
        return YoloNetwork(blueprint.architecture, blueprint.vehicle_classes)
    return build_torchvision(
        blueprint.architecture,
        len(blueprint.classes),
        blueprint.vehicle_classes,
        blueprint.norm_eps,
    )
