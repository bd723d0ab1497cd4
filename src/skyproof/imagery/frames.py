"""Reads whole annotated images at one resolution, with ignore regions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import Pixels, Window, tensor_of
from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.image_files import IMAGE_FOLDERS
from skyproof.imagery.labels.label import (
    GroundLabels,
    ImageLabels,
    Label,
    cut_to_image,
    refuse_beyond_images,
    require_classes,
    require_size,
    sort_labels,
)
from skyproof.pictures import LARGEST_PX, open_picture, upright_size_px, whole_picture

# Frames are decoded by Pillow, which reads fewer formats than GDAL.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_REMEDY = "replace it, leave it out, or cut it into smaller frames"

BORDER_PX = 40.0
"""Vehicles cut by an image's border are often not labelled: half a car's length at 6 cm, a whole
one at 12 cm."""


@dataclass(frozen=True)
class FramePicture:
    """An annotated frame that is resampled when it is read, with anti-aliasing."""

    path: Path
    source_size_px: tuple[int, int]
    size_px: tuple[int, int]

    def read(self) -> Pixels:
        # Pillow widens its kernel when it shrinks an image, so there is no aliasing.
        return tensor_of(self._decoded().resize(self.size_px, Image.Resampling.BICUBIC))

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        source = self._decoded()
        right, bottom = self.source_size_px
        scale_x, scale_y = right / self.size_px[0], bottom / self.size_px[1]
        for left, top, width, height in windows:
            last_x, last_y = (left + width) * scale_x, (top + height) * scale_y
            box = (left * scale_x, top * scale_y, min(last_x, right), min(last_y, bottom))
            # The kernel reads the pixels around the box, so that windows have no seams.
            yield tensor_of(source.resize((width, height), Image.Resampling.BICUBIC, box=box))

    def _decoded(self) -> Image.Image:
        return whole_picture(self.path, _REMEDY, error=ImageryError)


def read_frames_folder(
    folder: Path,
    *,
    labels: Path | None = None,
    gsd_m: float,
    target_gsd_m: float,
    classes: Sequence[str],
    border_px: float = BORDER_PX,
    pattern: str = "*",
) -> Dataset:
    """Reads images of 8 bits with labels in pixels, of any form that has images.

    Images lie in `folder`, its `images` or `JPEGImages`; labels lie in `folder` unless a path
    is given. Images are resampled to `target_gsd_m`. Objects of classes that are not named
    become ignore regions, as does a border of `border_px` source pixels.

    Raises:
        ImageryError: there are no images, or one is damaged or has no labels; the labels lack a
            class, have another form, map coordinates or another image size, or lie outside their
            image.
    """
    for place in (folder, *(folder / name for name in IMAGE_FOLDERS)):
        files = sorted(one for one in place.glob(pattern) if one.suffix.lower() in _SUFFIXES)
        if files:
            break
    if not files:
        raise ImageryError(f"{folder} holds no image matching {pattern!r}; give another folder.")
    place = folder if labels is None else labels
    annotations = read_labels(place)
    if isinstance(annotations, GroundLabels):
        raise ImageryError(
            f"{place} has labels in map coordinates but frames such as {files[0].name} have no "
            "place on the map; give labels in pixels, or cut georeferenced imagery with "
            "`skyproof ground`."
        )
    require_classes(annotations, classes, str(place))
    pictures, boxes, ignore = [], [], []
    sizes_px = {file: _size_px(file) for file in files}
    refuse_beyond_images(
        annotations, {file.stem: size_px for file, size_px in sizes_px.items()}, place
    )
    for file, source_px in sizes_px.items():
        of_image = _labels_of(file, source_px, annotations, place)
        truths, ignored = sort_labels(
            of_image, classes=classes, size_px=source_px, border_px=border_px
        )
        size_px = _resized(file, source_px, gsd_m, target_gsd_m)
        scale = torch.tensor([new / old for new, old in zip(size_px, source_px, strict=True)] * 2)
        pictures.append(FramePicture(file, source_px, size_px))
        boxes.append(truths * scale)
        ignore.append(ignored * scale)
    unknown = [torch.full((len(truths),), torch.nan) for truths in boxes]
    ids = [file.stem for file in files]
    return Dataset(pictures, boxes, ignore, ids, target_gsd_m, visible_fractions=unknown)


def _labels_of(
    file: Path, size_px: tuple[int, int], annotations: ImageLabels, place: Path
) -> Sequence[Label]:
    name = file.stem
    if name not in annotations.images:
        raise ImageryError(
            f"{file} has no labels in {place}; an image without vehicles needs an empty text "
            "file or an entry."
        )
    require_size(annotations, name, size_px, file, place)
    return tuple(
        cut_to_image(label, size_px, f"{place}, label {number} of {name},")
        for number, label in enumerate(annotations.images[name], 1)
    )


def _resized(
    file: Path, source_px: tuple[int, int], gsd_m: float, target_gsd_m: float
) -> tuple[int, int]:
    width, height = (max(1, round(side * gsd_m / target_gsd_m)) for side in source_px)
    if width * height > LARGEST_PX:
        raise ImageryError(
            f"{file} of {gsd_m} m per pixel would have {width:,} x {height:,} px at the "
            f"detector's {target_gsd_m} m, more than {LARGEST_PX:,} pixels in all; check its "
            "resolution, or cut it into smaller frames."
        )
    return width, height


def _size_px(path: Path) -> tuple[int, int]:
    with open_picture(path, _REMEDY, error=ImageryError) as picture:
        if picture.mode == "1":
            raise ImageryError(f"{path} holds 1-bit values; give photographs of 8 bits.")
        if picture.mode[0] in "IF":
            raise ImageryError(
                f"{path} has more than 8 bits per pixel; convert it (gdal_translate -ot Byte "
                "-scale)."
            )
        return upright_size_px(picture)
