"""Reads and checks the annotation file of our datasets: COCO with our additions."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

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
    """One vehicle, or with `iscrowd` a region that is not scored.

    Outlines make up most of the file, and only readers that ask for them keep them.

    Attributes:
        bbox: left, top, width and height in pixels.
        visible_fraction: share of its pixels that are inside the image and not hidden by the
            photograph; None if not known.
    """

    image_id: Seed
    bbox: tuple[Coordinate, Coordinate, _Length, _Length]
    iscrowd: Annotated[int, Meta(ge=0, le=1)]
    visible_fraction: Fraction | None = None


class AnnotationFile(msgspec.Struct, frozen=True):
    """The whole file."""

    info: Information
    images: tuple[ImageRow, ...]
    annotations: tuple[AnnotationRow, ...]


File = TypeVar("File", bound=AnnotationFile)


def read_annotations(folder: Path, kind: type[File]) -> tuple[File, list[Path]]:
    """Reads `annotations.json` of a dataset folder that `skyproof.datasets.coco.CocoWriter` wrote.

    `kind` is `AnnotationFile`, or a kind with more fields.

    Returns:
        The file's content, and the file of each image.

    Raises:
        StoredFileError: the file is missing, damaged or of another form; two images share an id, a
            name or a file; an annotation belongs to no image; an image lies outside the folder.
    """
    path = Path(folder) / ANNOTATIONS
    document: File = read_document(path, kind, REMEDY)
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

    Raises:
        StoredFileError: the file is missing, damaged or of another form.
    """
    known, _ = read_annotations(folder, AnnotationFile)
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
