"""Labelled images on disk: PNGs and one COCO annotation file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from skyproof.datasets.labelled import LabelledImages
from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_json

__all__ = [
    "Annotation",
    "CocoWriter",
    "encode_rle",
    "read_coco",
    "read_rendering",
    "read_visible_fractions",
]

CATEGORY = {"id": 1, "name": "vehicle", "supercategory": "vehicle"}


@dataclass(frozen=True)
class Annotation:
    """One vehicle in one image.

    Attributes:
        box_xyxy: pixels, half-open.
        centre_px: where the vehicle's centre lies, (x, y).
        visible_fraction: of its pixels, how many are inside the image.
        mask: `[H, W]` its visible pixels in the whole image, or None.
        vehicle: id in the fleet, or None where not known.
        placement_index: which of the scene's placements it is, or None.
        ignore: a region where nothing is scored (PAPER 1); COCO's iscrowd.
        corners_px: the rectangle on the ground that the vehicle stands on, (x, y) of front left, front right, rear
            right, rear left, not cut at the border; None where not known.
    """

    box_xyxy: tuple[float, float, float, float]
    centre_px: tuple[float, float]
    visible_fraction: float = 1.0
    mask: Bool[Tensor, "H W"] | None = None
    vehicle: str | None = None
    placement_index: int | None = None
    ignore: bool = False
    corners_px: tuple[tuple[float, float], ...] | None = None


class CocoWriter:
    """Writes a dataset image by image: `images/<scene id>.png`, and `annotations.json` when the block ends well.

    Put it inside `skyproof.files.finished_folder`, so that only a whole dataset gets its final name.

    Args:
        folder: gets the files.
        gsd_m: metres per pixel.
        source: what else `info` is to say, such as who rendered the images.
    """

    def __init__(
        self, folder: Path, *, gsd_m: float, source: Mapping[str, Any] | None = None
    ) -> None:
        self.folder = Path(folder)
        self._info = {
            "description": "skyproof scenes",
            "version": "1",
            "gsd_m": gsd_m,
            **(source or {}),
        }
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def __enter__(self) -> CocoWriter:
        (self.folder / "images").mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            document = {
                "info": self._info,
                "categories": [CATEGORY],
                "images": self._images,
                "annotations": self._annotations,
            }
            write_json(self.folder / "annotations.json", document)

    def add(
        self, image: UInt8[Tensor, "3 H W"], scene_id: str, annotations: Sequence[Annotation]
    ) -> None:
        """Writes one image and keeps its annotations for the end."""
        array = image.detach().cpu().permute(1, 2, 0).contiguous().numpy()
        # Speed before size: these images are written once and read a few times.
        Image.fromarray(array).save(self.folder / _file_name(scene_id), compress_level=1)
        self.add_written(scene_id, (image.shape[2], image.shape[1]), annotations)

    def add_written(
        self, scene_id: str, size_px: tuple[int, int], annotations: Sequence[Annotation]
    ) -> None:
        """Keeps the annotations of an image of width and height `size_px` that lies at its place already."""
        image_id, (width, height) = len(self._images) + 1, size_px
        self._images.append(
            {
                "id": image_id,
                "width": width,
                "height": height,
                "file_name": _file_name(scene_id),
                "scene_id": scene_id,
            }
        )
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


def read_coco(folder: Path) -> LabelledImages:
    """Reads a dataset that `CocoWriter` wrote; iscrowd annotations become ignore regions.

    Raises:
        StoredFileError: the folder is missing, damaged or without our resolution field.
    """
    path = Path(folder) / "annotations.json"
    document = read_json(path)
    try:
        gsd_m = float(document["info"]["gsd_m"])
        rows: dict[int, list[dict[str, Any]]] = {image["id"]: [] for image in document["images"]}
        for annotation in document["annotations"]:
            rows[annotation["image_id"]].append(annotation)
        names = [
            (Path(folder) / image["file_name"], image["scene_id"]) for image in document["images"]
        ]
        truths = [_boxes(rows[image["id"]], crowd=0) for image in document["images"]]
        ignored = [_boxes(rows[image["id"]], crowd=1) for image in document["images"]]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise StoredFileError(
            f"{path} is not a dataset of ours ({error!r}); write the dataset again."
        ) from error
    images = [_read_image(file) for file, _ in names]
    return LabelledImages(
        images=images, boxes=truths, ignore=ignored, ids=[name for _, name in names], gsd_m=gsd_m
    )


def read_visible_fractions(folder: Path) -> list[Float[Tensor, " _"]]:
    """Per image the visible fraction of each vehicle, in the order of `read_coco`'s boxes; nan where not known.

    Raises:
        StoredFileError: the folder is missing or damaged.
    """
    path = Path(folder) / "annotations.json"
    document = read_json(path)
    try:
        fractions: dict[int, list[float]] = {image["id"]: [] for image in document["images"]}
        for annotation in document["annotations"]:
            if not annotation["iscrowd"]:
                fractions[annotation["image_id"]].append(
                    float(annotation.get("visible_fraction", math.nan))
                )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StoredFileError(
            f"{path} is not a dataset of ours ({error!r}); write the dataset again."
        ) from error
    return [torch.tensor(values) for values in fractions.values()]


def read_rendering(folder: Path) -> tuple[str, dict[str, Any]]:
    """Who rendered a dataset ("torch" or "cycles"), and with which settings; none where the dataset does not say.

    Raises:
        StoredFileError: the folder is missing or damaged.
    """
    path = Path(folder) / "annotations.json"
    document = read_json(path)
    try:
        # Datasets of before there was a choice do not say it.
        return str(document["info"].get("renderer", "torch")), dict(
            document["info"].get("rendering", {})
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StoredFileError(
            f"{path} is not a dataset of ours ({error!r}); write the dataset again."
        ) from error


def _boxes(rows: list[dict[str, Any]], *, crowd: int) -> Tensor:
    boxes = torch.tensor(
        [row["bbox"] for row in rows if row["iscrowd"] == crowd], dtype=torch.float32
    ).reshape(-1, 4)
    return torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)


def _read_image(path: Path) -> UInt8[Tensor, "3 H W"]:
    try:
        with Image.open(path) as image:
            return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1).contiguous()
    except (OSError, SyntaxError, ValueError) as error:
        raise StoredFileError(
            f"{path} cannot be read ({error}); write the dataset again."
        ) from error
