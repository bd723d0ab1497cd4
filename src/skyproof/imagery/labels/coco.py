"""Reads COCO instance labels: one JSON file for all images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import ImageLabels, Label, require_inside
from skyproof.imagery.labels.text import stem_once

__all__ = ["parse_coco_labels"]


def parse_coco_labels(document: Mapping[str, Any], path: Path) -> ImageLabels:
    """Takes categories, images and boxes from a COCO document.

    Crowds are to be ignored; outlines are not read.

    Args:
        document: of the file.
        path: the file, for messages.

    Raises:
        ImageryError: a part of another form, an image or category that is not listed, or a box
            outside its image; names the annotation.
    """
    try:
        categories = {row["id"]: str(row["name"]) for row in document["categories"]}
        stems: dict[Any, str] = {}
        images: dict[str, list[Label]] = {}
        sizes_px: dict[str, tuple[int, int]] = {}
        for row in document["images"]:
            stem = Path(row["file_name"]).stem
            stem_once(stem, images, path)
            stems[row["id"]], images[stem] = stem, []
            if row.get("width") and row.get("height"):
                sizes_px[stem] = int(row["width"]), int(row["height"])
        rows = list(document["annotations"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ImageryError(
            f"{path} lacks images, annotations or categories of COCO's form ({error!r}); correct "
            "it."
        ) from error
    if not stems:
        raise ImageryError(f"{path} lists no images; give another file.")
    for number, row in enumerate(rows, 1):
        where = f"{path} annotation {row.get('id', number) if isinstance(row, dict) else number}"
        try:
            left, top, width, height = (float(value) for value in row["bbox"])
            image_id = row["image_id"]
            category_id = row["category_id"]
            ignore = bool(row.get("iscrowd", 0))
            if not all(map(math.isfinite, (left, top, width, height))):
                raise ValueError("not finite")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ImageryError(
                f"{where} has no image_id, category_id and bbox [x, y, w, h]; correct it."
            ) from error
        if image_id not in stems:
            raise ImageryError(
                f"{where} belongs to image {image_id}, which is not listed; correct it."
            )
        if category_id not in categories:
            known = ", ".join(f"{key} ({name})" for key, name in categories.items()) or "none"
            raise ImageryError(
                f"{where} has category {category_id} but the file lists {known}; correct it."
            )
        if width <= 0 or height <= 0:
            raise ImageryError(f"{where} has a box without size; correct it.")
        right, bottom = left + width, top + height
        corners = (left, top), (right, top), (right, bottom), (left, bottom)
        label = Label(categories[category_id], corners, ignore)
        stem = stems[image_id]
        if stem in sizes_px:
            require_inside(label, sizes_px[stem], where)
        images[stem].append(label)
    classes = tuple(dict.fromkeys(categories.values()))
    return ImageLabels(classes, {stem: tuple(labels) for stem, labels in images.items()}, sizes_px)
