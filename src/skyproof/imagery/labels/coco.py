"""Reads labels as COCO: boxes, or else outlines."""

from pathlib import Path, PureWindowsPath
from typing import Annotated

import msgspec
from msgspec import Meta

from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.imagery.labels.image_files import LabelledImages, damaged, upright_label
from skyproof.imagery.labels.label import ImageLabels
from skyproof.ranges import Coordinate

# Tools count, also in floats, or name every row.
_Id = (
    Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
    | Annotated[float, Meta(ge=-(2**63), le=2**63)]
    | Annotated[str, Meta(max_length=200)]
)
_ImageSize = Annotated[float, Meta(ge=0, le=1e6)]


class _CocoCategory(msgspec.Struct):
    id: _Id
    name: Annotated[str, Meta(max_length=200)]


class _CocoImage(msgspec.Struct):
    id: _Id
    file_name: Annotated[str, Meta(max_length=4000)]
    width: _ImageSize | None = None
    height: _ImageSize | None = None


class _CocoAnnotation(msgspec.Struct):
    image_id: _Id
    category_id: _Id
    bbox: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    id: _Id | None = None
    iscrowd: bool | Annotated[float, Meta(ge=0, le=1)] = 0


class _CocoFile(msgspec.Struct):
    categories: list[_CocoCategory]
    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


def read_coco_labels(path: Path) -> ImageLabels:
    """Reads categories, images and boxes of a COCO file; crowds become ignore regions."""
    document: _CocoFile = read_document(path, _CocoFile, "correct it", error=ImageryError)
    categories = {row.id: row.name for row in document.categories}
    images = LabelledImages(path)
    names: dict[float | str, str] = {}
    for image in document.images:
        # Only the name of a path counts: no file is opened by it.
        names[image.id] = PureWindowsPath(image.file_name).stem
        size_px = int(image.width or 0), int(image.height or 0)
        images.add_image(names[image.id], size_px if image.width and image.height else None)
    if not names:
        raise ImageryError(f"{path} lists no images; give another file.")
    for number, row in enumerate(document.annotations, 1):
        where = f"{path} annotation {number if row.id is None else row.id}"
        if row.image_id not in names:
            raise damaged(where, f"belongs to image {row.image_id}, which is not listed")
        if row.category_id not in categories:
            known = ", ".join(f"{key} ({name})" for key, name in categories.items()) or "none"
            what = f"has category {row.category_id} but the file lists {known[:500]}"
            raise damaged(where, what)
        left, top, width, height = row.bbox
        box = (left, top, left + width, top + height)
        label = upright_label(categories[row.category_id], box, where, bool(row.iscrowd))
        images.add(names[row.image_id], label, where)
    return images.with_classes(dict.fromkeys(categories.values()))
