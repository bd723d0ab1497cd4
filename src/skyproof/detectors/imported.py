"""An imported detector at its own resolution, ready to be evaluated and attacked."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from skyproof.detectors.anchor_detector import AnchorDetector
from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.common import (
    PADDING_GREY,
    SMALLEST_IMAGE_PX,
    check_images,
    check_targets,
)
from skyproof.detectors.detector import Boxes, Candidates, Images, TrainableDetector
from skyproof.detectors.imported_torchvision import build_torchvision
from skyproof.detectors.torchvision_detectors import TorchvisionDetector
from skyproof.detectors.ultralytics_detectors import YoloNetwork
from skyproof.errors import ConfigurationError


class ImportedDetector(TrainableDetector):
    """A network with imported weights: frozen, attacked through its loss against an empty truth.

    Images are resampled to the network's resolution with anti-aliasing, and boxes back to that of
    the images. The best vehicle class gives the score, and suppression runs over all vehicle
    classes together.
    """

    size = "brought"

    def __init__(self, name: str, blueprint: Blueprint) -> None:
        super().__init__()
        self.name = name
        self.image_scale = float(blueprint.image_scale)
        # The libraries draw weights, which are replaced at once: this must not change the program's
        # own draws.
        with torch.random.fork_rng(devices=[]):
            self.network = _network(blueprint)

    def loss(self, images: Images, targets: Sequence[Boxes]) -> Float[Tensor, " B"]:
        """The network's own loss per image against an empty truth, normalised (section 3.2).

        Raises:
            ConfigurationError: a target holds a vehicle; imported detectors are not trained here.
        """
        check_targets(images, targets)
        if any(len(boxes) for boxes in targets):
            raise ConfigurationError(
                f"{self.name} was imported, so that its loss knows no vehicles; train it "
                "where it came from."
            )
        return self.network.loss(self._scaled(images), targets)

    def candidates(self, images: Images) -> Candidates:
        """See `TrainableDetector.candidates`; boxes in pixels of `images`."""
        found = self.network.candidates(self._scaled(images))
        height, width = self.size_px(images)
        ratio = found.boxes.new_tensor(
            [images.shape[-1] / width, images.shape[-2] / height]
        ).repeat(2)
        return Candidates(found.boxes * ratio, found.scores, found.valid)

    def pyramid(self, images: Images) -> tuple[list[Tensor], int]:
        """See `TrainableDetector.pyramid`; of images at the network's resolution."""
        return self.network.pyramid(self._scaled(images))

    def size_px(self, images: Tensor) -> tuple[int, int]:
        """Height and width of images at the network's resolution."""
        return max(1, round(images.shape[-2] * self.image_scale)), max(
            1, round(images.shape[-1] * self.image_scale)
        )

    def _scaled(self, images: Tensor) -> Tensor:
        check_images(images)
        height, width = self.size_px(images)
        if (height, width) != tuple(images.shape[-2:]):
            images = functional.interpolate(
                images, size=(height, width), mode="bilinear", align_corners=False, antialias=True
            )
        # A small image at a coarse resolution may be too small for the network.
        margins = (0, max(0, SMALLEST_IMAGE_PX - width), 0, max(0, SMALLEST_IMAGE_PX - height))
        return functional.pad(images, margins, value=PADDING_GREY) if any(margins) else images


def _network(blueprint: Blueprint) -> TorchvisionDetector | YoloNetwork | AnchorDetector:
    if isinstance(blueprint.architecture, dict):
        network: YoloNetwork | AnchorDetector
        # The checkpoint gives the names of classes, its architecture the number in the head.
        if "anchors" in blueprint.architecture:
            known = int(blueprint.architecture.get("nc", 0))
            network = AnchorDetector(blueprint.architecture, blueprint.vehicle_classes, "brought")
        else:
            network = YoloNetwork(blueprint.architecture, blueprint.vehicle_classes)
            known = int(network.model.model[-1].nc)
        if max(blueprint.vehicle_classes) >= known:
            raise ConfigurationError(
                f"the vehicle class {max(blueprint.vehicle_classes)} is not among the {known} that "
                "the network tells apart; give a checkpoint as Ultralytics saves it."
            )
        return network
    return build_torchvision(
        blueprint.architecture,
        len(blueprint.classes),
        blueprint.vehicle_classes,
        blueprint.norm_eps,
    )
