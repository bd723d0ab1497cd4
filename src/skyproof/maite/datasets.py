"""Our datasets as MAITE datasets, and the data that MAITE's components exchange.

MAITE's protocols are structural, so nothing here imports the library.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import PictureFile
from skyproof.scenes.scene import Scene

LABELS = {0: "vehicle"}
"""Our detectors and datasets have one class."""

Batch = tuple[Sequence[Any], Sequence[Any], Sequence[Mapping[str, Any]]]
"""Images, targets and metadata, as MAITE's data loaders yield them."""


@dataclass(frozen=True, eq=False)
class Target:
    """A MAITE object-detection target: the true vehicles of an image, or the detections in it.

    Boxes are pixel xyxy, half-open, origin at the top-left corner; labels are zeros, the one class
    of `LABELS`; scores are in [0, 1], ones for true vehicles.
    """

    boxes: Float[np.ndarray, "N 4"]
    labels: np.ndarray
    scores: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, boxes: Float[Tensor, "N 4"], scores: Float[Tensor, " N"] | None = None) -> "Target":
        """Makes a target of vehicles; without scores they are true ones."""
        scores = torch.ones(len(boxes)) if scores is None else scores
        own, sure = (each.detach().cpu().numpy().astype(np.float32) for each in (boxes, scores))
        return cls(own, np.zeros(len(boxes), dtype=np.int64), sure)


def batches(dataset: Any, size: int) -> Iterator[Batch]:
    """Reads a MAITE dataset batch by batch."""
    for start in range(0, len(dataset), size):
        data = [dataset[index] for index in range(start, min(start + size, len(dataset)))]
        images, targets, metadata = zip(*data, strict=True)
        yield list(images), list(targets), list(metadata)


class VehicleDataset:
    """A dataset folder of ours as a MAITE object-detection dataset, with access field by field.

    Besides its `id`, the metadata of an image holds

    - `img_gsd`: metres per pixel, the key that NRTK's sensor models read;
    - `ignore`: `[m][4]` regions that are not scored, for which MAITE has no field;
    - for rendered scenes `rendering`, the renderer and a digest of its settings; `place`, the tile
    of ground; `vehicles` and `placements`, the fleet's vehicle and the index in the scene of each
    box; and `sun_elevation_deg`, `sun_azimuth_deg`, `tilt_deg` and `weather`.

    A vehicle out of sight, whose box has no area, is left out.

    Args:
        folder: a folder that `skyproof render` or `skyproof imagery frames` wrote.

    Attributes:
        metadata: `id`, the folder's name and the first digits of a digest of its labels and of the
            sizes of its image files; `index2label`; and `gsd_m`, our own addition.

    Raises:
        StoredFileError: the folder is missing or damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self._images = Dataset.open(folder)
        scenes = Path(folder) / "scenes.jsonl"
        self._scenes = self._images.scenes if scenes.exists() else None
        self._rendering = _rendering(self._images)
        name = Path(folder).resolve().name
        self.metadata: dict[str, Any] = {
            "id": f"{name}-{_digest(self._images)[:12]}",
            "index2label": dict(LABELS),
            "gsd_m": self._images.gsd_m,
        }

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, ind: int, /) -> tuple[np.ndarray, Target, dict[str, Any]]:
        """Gives image, target and metadata; raises IndexError beyond the last image."""
        return self.get_input(ind), self.get_target(ind), self.get_metadata(ind)

    def get_input(self, index: int, /) -> np.ndarray:
        """Decodes one image: `[3, H, W]` sRGB bytes."""
        return self._images.image(self._within(index)).numpy()

    def get_target(self, index: int, /) -> Target:
        """Gives the vehicles in sight, without decoding the image."""
        index = self._within(index)
        return Target.of(self._images.boxes[index][self._in_sight(index)])

    def get_metadata(self, index: int, /) -> dict[str, Any]:
        """Gives the known facts about one image, without decoding it."""
        index = self._within(index)
        told: dict[str, Any] = {
            "id": self._images.ids[index],
            "img_gsd": self._images.gsd_m,
            "ignore": self._images.ignore[index].tolist(),
        }
        if self._scenes is not None:
            told["rendering"] = self._rendering
            told |= scene_metadata(self._scenes[index], self._in_sight(index).nonzero()[0].tolist())
        return told

    def _within(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"There are {len(self)} images, so there is no number {index}.")
        return index % len(self)

    def _in_sight(self, index: int) -> np.ndarray:
        boxes = self._images.boxes[index]
        return ((boxes[:, 2:] - boxes[:, :2]) > 0).all(1).numpy()


def scene_metadata(scene: Scene, placements: list[int]) -> dict[str, Any]:
    """Gives the MAITE metadata of a scene with these placements in sight."""
    return {
        "place": scene.background.tile,
        "vehicles": [scene.placements[place].vehicle for place in placements],
        "placements": placements,
        "sun_elevation_deg": math.degrees(scene.sun.elevation_rad),
        "sun_azimuth_deg": math.degrees(scene.sun.azimuth_rad) % 360,
        "tilt_deg": math.degrees(scene.camera.tilt_rad),
        "weather": scene.weather.condition,
    }


def _rendering(images: Dataset) -> str:
    settings = json.dumps(images.rendering, sort_keys=True, default=str)
    return f"{images.renderer}-{hashlib.sha256(settings.encode()).hexdigest()[:12]}"


def _digest(images: Dataset) -> str:
    """Distinguishes sets, including the same scenes with and without a camouflage."""
    # Labels are the same under every texture, and reading all images would take long.
    sizes = [
        picture.path.stat().st_size
        for picture in images.pictures
        if isinstance(picture, PictureFile) and picture.path.exists()
    ]
    return hashlib.sha256(f"{images.digest} {sizes}".encode()).hexdigest()
