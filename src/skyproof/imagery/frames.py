"""Whole annotated images: read, brought to one resolution, ignore regions set (PAPER 1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from skyproof.datasets.labelled import LabelledImages
from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import GroundLabels, require_classes, require_inside, sort_labels
from skyproof.imagery.labels.text import IMAGE_SUFFIXES

__all__ = ["BORDER_PX", "read_frames_folder"]

BORDER_PX = 40.0
"""Vehicles cut by an image's border are often not labelled: half a car's length at 6 cm, a whole one at 12 cm."""


def read_frames_folder(
    folder: Path,
    *,
    labels: Path | None = None,
    gsd_m: float,
    target_gsd_m: float,
    classes: Sequence[str],
    border_px: float = BORDER_PX,
    pattern: str = "*",
) -> LabelledImages:
    """Reads images of 8 bits with labels in pixels: COCO, YOLO text or DOTA text.

    Args:
        folder: holds the images, or an `images` folder that does.
        labels: as `read_labels` takes them; `folder` itself where None.
        gsd_m: metres per pixel of the images.
        target_gsd_m: what they are resampled to, with anti-aliasing; boxes are scaled along.
        classes: names that count as vehicles; every other class becomes an ignore region.
        border_px: in a band this wide (source pixels) nothing is scored; a box whose centre lies in it becomes an
            ignore region.
        pattern: only images whose file name matches, for folders of more than one resolution or place.

    Raises:
        ImageryError: no images, an image that is damaged or has no labels, a class that the labels do not know, labels
            of another form, in map coordinates, of another image size or outside their image.
    """
    folder = Path(folder)
    files = sorted(file for file in folder.glob(pattern) if file.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        files = sorted(
            file
            for file in (folder / "images").glob(pattern)
            if file.suffix.lower() in IMAGE_SUFFIXES
        )
    if not files:
        raise ImageryError(f"{folder} holds no image matching {pattern!r}; give another folder.")
    place = Path(labels) if labels is not None else folder
    read = read_labels(place)
    if isinstance(read, GroundLabels):
        raise ImageryError(
            f"{place} has labels in map coordinates but frames such as {files[0].name} have no place on the map; give "
            "labels in pixels, or cut georeferenced imagery with `skyproof ground`."
        )
    require_classes(read, classes, str(place))
    images, boxes, ignore = [], [], []
    for file in files:
        if file.stem not in read.images:
            raise ImageryError(
                f"{file} has no labels in {place}; an image without vehicles needs an empty text file or an entry."
            )
        picture = _picture(file)
        width, height = picture.size
        if (stated := read.sizes_px.get(file.stem, picture.size)) != picture.size:
            raise ImageryError(
                f"{file} has {width} x {height} px but {place} says {stated[0]} x {stated[1]}; give the images that "
                "were labelled."
            )
        own = read.images[file.stem]
        for number, label in enumerate(own, 1):
            require_inside(label, picture.size, f"{place}, label {number} of {file.stem},")
        # Labels in pixels have corners, never a point alone.
        truths, ignored = sort_labels(
            own, classes=classes, size_px=picture.size, border_px=border_px, point_box_px=0.0
        )
        size = (
            max(1, round(width * gsd_m / target_gsd_m)),
            max(1, round(height * gsd_m / target_gsd_m)),
        )
        # Pillow widens its kernel when it shrinks, so this does not alias.
        array = np.array(picture.resize(size, Image.Resampling.BICUBIC))
        images.append(torch.from_numpy(array).permute(2, 0, 1).contiguous())
        scale = torch.tensor([size[0] / width, size[1] / height] * 2, dtype=torch.float32)
        boxes.append(truths * scale)
        ignore.append(ignored * scale)
    return LabelledImages(
        images=images,
        boxes=boxes,
        ignore=ignore,
        ids=[file.stem for file in files],
        gsd_m=target_gsd_m,
    )


def _picture(path: Path) -> Image.Image:
    try:
        with Image.open(path) as picture:
            if picture.mode[0] in "IF":
                raise ImageryError(
                    f"{path} has more than 8 bits per pixel; convert it (gdal_translate -ot Byte -scale)."
                )
            return picture.convert("RGB")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageryError(
            f"{path} cannot be read as an image ({error}); replace or remove it."
        ) from error
