"""Writes labelled images to a folder: PNGs and one COCO annotation file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image
from torch import Tensor

from skyproof.datasets.pictures import Pixels
from skyproof.files import write_json

DESCRIPTION = "skyproof scenes"
"""The description in `info` unless another is given: the images are rendered."""

CATEGORY = {"id": 1, "name": "vehicle", "supercategory": "vehicle"}


@dataclass(frozen=True)
class Annotation:
    """One vehicle in one image.

    Attributes:
        box_xyxy: pixels, half-open.
        centre_px: centre of the vehicle, (x, y).
        visible_fraction: share of its pixels that are inside the image and not hidden by the
            photograph.
        mask: `[H, W]` its visible pixels in the whole image, or None.
        vehicle: id in the fleet, or None if not known.
        placement_index: index of the scene's placement, or None.
        ignore: whether this is a region that is not scored; COCO's iscrowd.
        corners_px: rectangle of ground below the vehicle, (x, y) of front left, front right, rear
            right, rear left, not clipped to the image; None if not known.
        unlabelled: whether this is an ignore region that holds no object but was never labelled.
    """

    box_xyxy: tuple[float, float, float, float]
    centre_px: tuple[float, float]
    visible_fraction: float = 1.0
    mask: Bool[Tensor, "H W"] | None = None
    vehicle: str | None = None
    placement_index: int | None = None
    ignore: bool = False
    corners_px: tuple[tuple[float, float], ...] | None = None
    unlabelled: bool = False


class CocoWriter:
    """Writes a dataset image by image, and its annotations if the block ends well.

    The images are `images/<scene id>.png`, the annotations `annotations.json`. Use it inside
    `skyproof.files.finished_folder`, so that only a complete dataset gets its final name. `source`
    holds further entries of `info`, such as the renderer of the images.
    """

    def __init__(
        self, folder: Path, *, gsd_m: float, source: Mapping[str, Any] | None = None
    ) -> None:
        self.folder = Path(folder)
        self._info = {"description": DESCRIPTION, "version": "1", "gsd_m": gsd_m, **(source or {})}
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def __enter__(self) -> CocoWriter:
        (self.folder / "images").mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            document = {
                "info": self._info,
                "categories": [CATEGORY],
                "images": self._images,
                "annotations": self._annotations,
            }
            write_json(self.folder / "annotations.json", document)

    def add(self, image: Pixels, scene_id: str, annotations: Sequence[Annotation]) -> None:
        """Writes one image and keeps its annotations for the end."""
        array = image.detach().cpu().permute(1, 2, 0).contiguous().numpy()
        # Speed before size: these images are written once and read a few times.
        Image.fromarray(array).save(self.folder / _file_name(scene_id), compress_level=1)
        self.add_written(scene_id, (image.shape[2], image.shape[1]), annotations)

    def add_written(
        self, scene_id: str, size_px: tuple[int, int], annotations: Sequence[Annotation]
    ) -> None:
        """Keeps the annotations of an image that is already in the folder."""
        image_id = len(self._images) + 1
        width, height = size_px
        size: dict[str, Any] = {"id": image_id, "width": width, "height": height}
        self._images.append(size | {"file_name": _file_name(scene_id), "scene_id": scene_id})
        for annotation in annotations:
            left, top, right, bottom = annotation.box_xyxy
            row: dict[str, Any] = {
                "id": len(self._annotations) + 1,
                "image_id": image_id,
                "category_id": CATEGORY["id"],
                "bbox": [left, top, right - left, bottom - top],
                "area": (right - left) * (bottom - top),
                "iscrowd": int(annotation.ignore),
                "centre_px": list(annotation.centre_px),
                "visible_fraction": annotation.visible_fraction,
                "vehicle": annotation.vehicle,
                "placement_index": annotation.placement_index,
            }
            if annotation.corners_px is not None:
                row["corners_px"] = [list(corner) for corner in annotation.corners_px]
            if annotation.unlabelled:
                row["unlabelled"] = True
            if annotation.mask is not None:
                row["segmentation"] = encode_rle(annotation.mask)
                row["area"] = float(annotation.mask.sum())
            self._annotations.append(row)


def _file_name(scene_id: str) -> str:
    return f"images/{scene_id}.png"


def encode_rle(mask: Bool[Tensor, "H W"]) -> dict[str, list[int]]:
    """Uncompressed COCO run lengths: column by column, the first count is of zeros."""
    height, width = mask.shape
    flat = mask.detach().cpu().numpy().ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(np.concatenate([[0], changes, [flat.size]])).tolist()
    starts_set = bool(flat.size and flat[0])
    return {"size": [height, width], "counts": [0, *counts] if starts_set else counts}
