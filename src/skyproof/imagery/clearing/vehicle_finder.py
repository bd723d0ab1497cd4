"""Finds vehicles in tiles of any size: from labels, and from a detector."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torchvision import ops

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detector
from skyproof.detectors.inference import covering_windows, detect_batch
from skyproof.detectors.loaded import LoadedDetector
from skyproof.errors import ConfigurationError
from skyproof.scenes.splits import SPLITS

__all__ = ["VehicleFinder", "check_resolution", "other_vehicles", "read_boxes"]

SAME_VEHICLE_IOU = 0.3


@dataclass(frozen=True)
class VehicleFinder:
    """A detector that looks at tiles of any size.

    Attributes:
        loaded: the detector with its card.
        name: for the record, such as its folder and the digest of its weights.
    """

    loaded: LoadedDetector[Detector]
    name: str

    def boxes(self, image: UInt8[Tensor, "3 H W"], lowest_score: float) -> Float[Tensor, "n 4"]:
        """Finds vehicles in a tile of any size, a large one through windows that overlap."""
        detected = []
        for left, top, width, height in covering_windows((image.shape[2], image.shape[1])):
            part = image[:, top : top + height, left : left + width]
            detections = detect_batch(self.loaded.detector, part[None])[0]
            shift = torch.tensor([left, top, left, top], dtype=torch.float32)
            keep = detections.scores.cpu() >= lowest_score
            detected.append((detections.boxes.cpu()[keep] + shift, detections.scores.cpu()[keep]))
        boxes = torch.cat([f[0] for f in detected])
        scores = torch.cat([f[1] for f in detected])
        return boxes[ops.nms(boxes, scores, 0.5)].reshape(-1, 4)


def read_boxes(folder: Path) -> dict[str, Float[Tensor, "_ 4"]] | None:
    """Reads the labelled boxes of every tile id, vehicles and ignore regions alike.

    None where the folder has no labels.

    Raises:
        StoredFileError: an annotation file is damaged.
    """
    folders = [Path(folder) / split for split in SPLITS]
    datasets = [
        Dataset.open(split_folder)
        for split_folder in folders
        if (split_folder / "annotations.json").is_file()
    ]
    if not datasets:
        return None
    return {
        name: torch.cat((vehicles, ignored))
        for data in datasets
        for name, vehicles, ignored in zip(data.ids, data.boxes, data.ignore, strict=True)
    }


def other_vehicles(boxes: Tensor, known: Tensor) -> Tensor:
    """Returns boxes of vehicles that are not among the known ones: IoU below 0.3 with each."""
    if not len(known) or not len(boxes):
        return boxes
    return boxes[ops.box_iou(boxes, known).max(dim=1).values < SAME_VEHICLE_IOU]


def check_resolution(finder: VehicleFinder | None, gsd_m: float) -> None:
    """Refuses a detector that was trained at another resolution.

    Raises:
        ConfigurationError: more than 2 % apart.
    """
    if finder is not None and abs(finder.loaded.card.gsd_m - gsd_m) > 0.02 * gsd_m:
        raise ConfigurationError(
            f"The detector {finder.name} was trained at {finder.loaded.card.gsd_m} m per pixel but "
            f"the tiles have {gsd_m} m; give one of this resolution, or tile the imagery at the "
            "detector's."
        )
