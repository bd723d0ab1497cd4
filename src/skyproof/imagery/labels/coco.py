"""Reads COCO instance labels: one JSON file for all images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import ImageLabels, Label, require_inside
from skyproof.imagery.labels.text import name_once
from skyproof.imagery.tiles.georeference import image_name
from skyproof.ranges import Coordinate

# Tools count, or give every row a name of its own.
_Id = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)] | Annotated[str, Meta(max_length=200)]
_Side = Annotated[float, Meta(ge=0, le=1e6)]


class _Category(msgspec.Struct):
    id: _Id
    name: Annotated[str, Meta(max_length=200)]


class _Image(msgspec.Struct):
    id: _Id
    file_name: Annotated[str, Meta(max_length=4000)]
    width: _Side | None = None
    height: _Side | None = None


class _Annotation(msgspec.Struct):
    image_id: _Id
    category_id: _Id
    bbox: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    id: _Id | None = None
    iscrowd: bool | Annotated[float, Meta(ge=0, le=1)] = 0


class _Document(msgspec.Struct):
    """COCO; what else a file holds (outlines, licences) is passed over."""

    categories: list[_Category]
    images: list[_Image]
    annotations: list[_Annotation]


def read_coco_labels(path: Path) -> ImageLabels:
    """Takes categories, images and boxes from a COCO file.

    Crowds are to be ignored; outlines are not read.

    Raises:
        ImageryError: a part of another form, an image or category that is not listed, or a box
            outside its image; names the annotation.
    """
    document: _Document = read_document(path, _Document, "correct it", error=ImageryError)
    categories = {row.id: row.name for row in document.categories}
    names: dict[int | str, str] = {}
    images: dict[str, list[Label]] = {}
    sizes_px: dict[str, tuple[int, int]] = {}
    for image in document.images:
        # Of a path only the name counts: no file is opened by it.
        name = image_name(Path(image.file_name))
        name_once(name, images, path)
        names[image.id], images[name] = name, []
        if image.width and image.height:
            sizes_px[name] = int(image.width), int(image.height)
    if not names:
        raise ImageryError(f"{path} lists no images; give another file.")
    for number, row in enumerate(document.annotations, 1):
        where = f"{path} annotation {number if row.id is None else row.id}"
        if row.image_id not in names:
            raise ImageryError(
                f"{where} belongs to image {row.image_id}, which is not listed; correct it."
            )
        if row.category_id not in categories:
            known = ", ".join(f"{key} ({name})" for key, name in categories.items()) or "none"
            raise ImageryError(
                f"{where} has category {row.category_id} but the file lists {known[:500]}; correct "
                "it."
            )
        left, top, width, height = row.bbox
        if width <= 0 or height <= 0:
            raise ImageryError(f"{where} has a box without size; correct it.")
        right, bottom = left + width, top + height
        corners = (left, top), (right, top), (right, bottom), (left, bottom)
        label = Label(categories[row.category_id], corners, bool(row.iscrowd))
        name = names[row.image_id]
        if name in sizes_px:
            require_inside(label, sizes_px[name], where)
        images[name].append(label)
    classes = tuple(dict.fromkeys(categories.values()))
    return ImageLabels(classes, {name: tuple(labels) for name, labels in images.items()}, sizes_px)
