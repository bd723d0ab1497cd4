"""Writes and reads labelled images in a folder: PNGs, and COCO annotations with our additions."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Bool
from msgspec import Meta
from PIL import Image
from torch import Tensor

from skyproof.datasets.pictures import REMEDY, PictureFile, Pixels
from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import inside, write_json
from skyproof.ranges import (
    Coordinate,
    FileReference,
    Fraction,
    GroundResolution,
    ImageSide,
    Name,
    Seed,
)

ANNOTATIONS = "annotations.json"

# Label tools round coordinates, so a box may reach over the edge by a pixel.
_SLACK = 0.005
_Length = Annotated[float, Meta(ge=0, le=1e9)]
CATEGORY = {"id": 1, "name": "vehicle", "supercategory": "vehicle"}


@dataclass(frozen=True)
class Annotation:
    """One vehicle in one image, or a region that is not scored (`ignore`).

    Attributes:
        visible_fraction: share of the vehicle's pixels that are inside the image and not hidden by
            the photograph.
        mask: the vehicle's visible pixels in the whole image.
        vehicle: id in the fleet.
        placement_index: index of the scene's placement.
        corners_px: rectangle of ground below the vehicle, (x, y) of front left, front right, rear
            right, rear left, not clipped to the image.
        unlabelled: whether an ignore region was never labelled.
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

    Use it inside `finished_folder`. `source` holds further entries of `info`, such as the renderer.
    """

    def __init__(
        self, folder: Path, *, gsd_m: float, source: Mapping[str, Any] | None = None
    ) -> None:
        self.folder = Path(folder)
        usual = {"description": "skyproof scenes", "version": "1", "gsd_m": gsd_m}
        self._info = {**usual, **(source or {})}
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def __enter__(self) -> "CocoWriter":
        (self.folder / "images").mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            rows = {"images": self._images, "annotations": self._annotations}
            document = {"info": self._info, "categories": [CATEGORY], **rows}
            write_json(self.folder / ANNOTATIONS, document)

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
    """Encodes a mask as uncompressed COCO run lengths: column by column, zeros first."""
    flat = mask.detach().cpu().numpy().ravel(order="F")
    changes = np.flatnonzero(np.diff(flat, prepend=False))
    counts = np.diff(np.concatenate([[0], changes, [flat.size]]))
    return {"size": list(mask.shape), "counts": counts.tolist()}


class Information(msgspec.Struct, frozen=True):
    """The file's facts about the whole set; the camouflage is a digest, or empty."""

    gsd_m: GroundResolution
    description: str = ""
    renderer: str | None = None
    rendering: Mapping[str, Any] = {}
    camouflage: Annotated[str, Meta(max_length=64)] = ""


class ImageRow(msgspec.Struct, frozen=True):
    id: Seed
    width: ImageSide
    height: ImageSide
    file_name: FileReference
    scene_id: Name


class AnnotationRow(msgspec.Struct, frozen=True):
    """One vehicle, or with `iscrowd` a region that is not scored; outlines are not kept.

    `bbox` is left, top, width and height in pixels; the other fields are those of `Annotation`, or
    None if not known.
    """

    image_id: Seed
    bbox: tuple[Coordinate, Coordinate, _Length, _Length]
    iscrowd: Annotated[int, Meta(ge=0, le=1)]
    visible_fraction: Fraction | None = None
    centre_px: tuple[Coordinate, Coordinate] | None = None
    corners_px: tuple[tuple[Coordinate, Coordinate], ...] | None = None
    unlabelled: bool = False


def is_within(box_xyxy: Sequence[float], size_px: tuple[int, int]) -> bool:
    """Tells whether a box lies in its image, up to rounding by half a percent."""
    slack_x, slack_y = (_SLACK * side for side in size_px)
    left, top, right, bottom = box_xyxy
    inside = left >= -slack_x and top >= -slack_y
    return inside and right <= size_px[0] + slack_x and bottom <= size_px[1] + slack_y


class AnnotationFile(msgspec.Struct, frozen=True):
    info: Information
    images: tuple[ImageRow, ...]
    annotations: tuple[AnnotationRow, ...]

    @property
    def rows_by_image(self) -> list[list[AnnotationRow]]:
        """The annotations of each image, in the order of the images."""
        rows: dict[int, list[AnnotationRow]] = {image.id: [] for image in self.images}
        for annotation in self.annotations:
            rows[annotation.image_id].append(annotation)
        return list(rows.values())


def read_annotations(folder: Path) -> tuple[AnnotationFile, list[PictureFile]]:
    """Reads `annotations.json` of a dataset folder, and returns its pictures, too.

    Raises:
        StoredFileError: the file is missing, damaged or of another form; two images share an id, a
            name or a file; an annotation belongs to no image; an image lies outside the folder.
    """
    path = Path(folder) / ANNOTATIONS
    document: AnnotationFile = read_document(path, AnnotationFile, REMEDY)
    for what in ("id", "scene_id", "file_name"):
        seen: set[Any] = set()
        for row in document.images:
            value = getattr(row, what)
            if value in seen:
                raise StoredFileError(f"{path} has two images of {what} {value!r}; {REMEDY}.")
            seen.add(value)
    known = {row.id for row in document.images}
    for number, annotation in enumerate(document.annotations):
        if annotation.image_id not in known:
            raise StoredFileError(
                f"{path}, annotations[{number}] belongs to image {annotation.image_id}, which is "
                f"not listed; {REMEDY}."
            )
    return document, [
        PictureFile(inside(folder, row.file_name, path), (row.width, row.height))
        for row in document.images
    ]


def drop_images(folder: Path, names: Collection[str]) -> None:
    """Removes images by their `scene_id` from `annotations.json`; all else stays."""
    dropped = {row.id for row in read_annotations(folder)[0].images if row.scene_id in names}
    if not dropped:
        return
    path = Path(folder) / ANNOTATIONS
    # A second read keeps all fields that other programs may have added.
    document: dict[str, Any] = read_document(path, dict[str, Any], REMEDY)
    for name, key in (("images", "id"), ("annotations", "image_id")):
        document[name] = [row for row in document[name] if row[key] not in dropped]
    write_json(path, document)
