"""Reads and checks the annotation file of our datasets: COCO with our additions."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

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
REMEDY = "copy the whole folder again, or make the dataset again"

# Label tools round, and may let a box reach over the edge by a pixel.
_SLACK = 0.005
_Length = Annotated[float, Meta(ge=0, le=1e9)]


class Information(msgspec.Struct, frozen=True):
    """The file's facts about the whole set.

    Attributes:
        gsd_m: metres per pixel of all images.
        description: short description of the images.
        renderer: renderer of the images; None if not stated.
        rendering: settings of the renderer.
        camouflage: digest of the vehicles' camouflage; empty without camouflage, and in older sets.
    """

    gsd_m: GroundResolution
    description: str = ""
    renderer: str | None = None
    rendering: Mapping[str, Any] = {}
    camouflage: Annotated[str, Meta(max_length=64)] = ""


class ImageRow(msgspec.Struct, frozen=True):
    """One image: its file below the dataset's folder, and the name of its scene."""

    id: Seed
    width: ImageSide
    height: ImageSide
    file_name: FileReference
    scene_id: Name


class AnnotationRow(msgspec.Struct, frozen=True):
    """One vehicle, or with `iscrowd` a region that is not scored. Outlines are not kept.

    Attributes:
        bbox: left, top, width and height in pixels.
        visible_fraction: share of its pixels that are inside the image and not hidden by the
            photograph; None if not known.
        centre_px: middle of the vehicle, (x, y); None if not known.
        corners_px: corners on the ground, as in `Annotation`; None if not known.
        unlabelled: whether the region was never labelled.
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
    """The whole file."""

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


def read_annotations(folder: Path) -> tuple[AnnotationFile, list[Path]]:
    """Reads `annotations.json` of a dataset folder that `skyproof.datasets.coco.CocoWriter` wrote.

    Returns:
        The file's content, and the file of each image.

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
    return document, [inside(folder, row.file_name, path) for row in document.images]


def drop_images(folder: Path, names: Collection[str]) -> None:
    """Removes images and their annotations from `annotations.json`; all else stays.

    Names (`scene_id`) that the dataset lacks are ignored.
    """
    known, _ = read_annotations(folder)
    dropped = {row.id for row in known.images if row.scene_id in names}
    if not dropped:
        return
    path = Path(folder) / ANNOTATIONS
    # A second read keeps all fields that other programs may have added.
    document: dict[str, Any] = read_document(path, dict[str, Any], REMEDY)
    document["images"] = [row for row in document["images"] if row["id"] not in dropped]
    document["annotations"] = [
        row for row in document["annotations"] if row["image_id"] not in dropped
    ]
    write_json(path, document)
