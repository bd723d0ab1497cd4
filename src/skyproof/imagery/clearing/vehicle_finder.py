"""Finds vehicles in tiles of any size by a detector."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torchvision import ops

from skyproof.detectors.detector import Detections, Detector, TrainableDetector
from skyproof.detectors.inference import covering_windows, detect_batch
from skyproof.errors import ConfigurationError

SAME_VEHICLE_IOU = 0.3


@dataclass(frozen=True)
class VehicleFinder:
    """A detector that looks at tiles of any size.

    Attributes:
        name: for the record, such as its folder and the digest of its weights.
    """

    detector: Detector
    name: str

    @classmethod
    def of_folder(cls, detector: Detector, folder: Path, device: torch.device) -> VehicleFinder:
        """Names a detector by its folder and its weights' digest, and moves it to a device."""
        if not isinstance(detector, TrainableDetector):
            return cls(detector, f"{folder} (by its answers)")
        return cls(detector.to(device), f"{folder} ({detector.weights_sha256[:12]})")

    def detections(self, image: UInt8[Tensor, "3 H W"], lowest_score: float) -> Detections:
        """Finds vehicles in a tile of any size, a large one through windows that overlap."""
        detected = []
        for left, top, width, height in covering_windows((image.shape[2], image.shape[1])):
            part = image[:, top : top + height, left : left + width]
            detections = detect_batch(self.detector, part[None])[0]
            shift = torch.tensor([left, top, left, top], dtype=torch.float32)
            keep = detections.scores.cpu() >= lowest_score
            detected.append((detections.boxes.cpu()[keep] + shift, detections.scores.cpu()[keep]))
        boxes = torch.cat([f[0] for f in detected])
        scores = torch.cat([f[1] for f in detected])
        kept = ops.nms(boxes, scores, 0.5)
        return Detections(boxes[kept].reshape(-1, 4), scores[kept])


def other_vehicles(detections: Detections, known: Float[Tensor, "n 4"]) -> Detections:
    """Returns those that are not among the known vehicles: IoU below 0.3 with each."""
    boxes = detections.boxes
    if not len(known) or not len(boxes):
        return detections
    other = ops.box_iou(boxes, known).max(dim=1).values < SAME_VEHICLE_IOU
    return Detections(boxes[other], detections.scores[other])


def grown_to_what_is_seen(
    known: Float[Tensor, "n 4"], detections: Detections
) -> Float[Tensor, "n 4"]:
    """Grows known boxes so that they hold the same vehicles as they were detected.

    A label that is a point stands for a square, beyond which bumpers would be left. Of several
    detections of one vehicle (IoU of at least 0.3) the likest counts; no box shrinks.
    """
    boxes = detections.boxes
    if not len(known) or not len(boxes):
        return known
    likeness, nearest = ops.box_iou(known, boxes).max(dim=1)
    seen = boxes[nearest]
    grown = torch.cat(
        [torch.minimum(known[:, :2], seen[:, :2]), torch.maximum(known[:, 2:], seen[:, 2:])], dim=1
    )
    return torch.where((likeness >= SAME_VEHICLE_IOU)[:, None], grown, known)


def check_resolution(finder: VehicleFinder | None, gsd_m: float) -> None:
    """Refuses a detector that was trained at another resolution.

    Raises:
        ConfigurationError: more than 2 % apart.
    """
    if finder is not None and abs(finder.detector.card.gsd_m - gsd_m) > 0.02 * gsd_m:
        raise ConfigurationError(
            f"The detector {finder.name} was trained at {finder.detector.card.gsd_m} m per pixel "
            f"but the tiles have {gsd_m} m; give one of this resolution, or tile the imagery at "
            "the detector's."
        )
