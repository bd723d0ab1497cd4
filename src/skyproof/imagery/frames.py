"""Whole annotated images: read, brought to one resolution, ignore regions set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import Window, tensor_of
from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import GroundLabels, require_classes, require_inside, sort_labels
from skyproof.imagery.tiles.georeference import image_name
from skyproof.pictures import LARGEST_PX, open_picture, whole_picture

# Frames are decoded by Pillow, which reads fewer forms than what cuts tiles.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_REMEDY = "replace it, leave it out, or cut it into smaller frames"

BORDER_PX = 40.0
"""Vehicles cut by an image's border are often not labelled: half a car's length at 6 cm, a whole
one at 12 cm."""


@dataclass(frozen=True)
class FramePicture:
    """An annotated frame that is brought to another resolution when somebody looks at it."""

    path: Path
    source_size_px: tuple[int, int]
    size_px: tuple[int, int]

    def read(self) -> UInt8[Tensor, "3 H W"]:
        """Decodes and resamples the whole frame, with anti-aliasing.

        Raises:
            ImageryError: the file is missing or damaged.
        """
        # Pillow widens its kernel when it shrinks, so this does not alias.
        return tensor_of(self._decoded().resize(self.size_px, Image.Resampling.BICUBIC))

    def windows(self, windows: Sequence[Window]) -> Iterator[UInt8[Tensor, "3 _h _w"]]:
        """Decodes the frame and yields windows of the resampled picture, each made by itself.

        Raises:
            ImageryError: the file is missing or damaged.
        """
        source = self._decoded()
        scale_x = self.source_size_px[0] / self.size_px[0]
        scale_y = self.source_size_px[1] / self.size_px[1]
        for left, top, width, height in windows:
            box = (
                left * scale_x,
                top * scale_y,
                min((left + width) * scale_x, self.source_size_px[0]),
                min((top + height) * scale_y, self.source_size_px[1]),
            )
            # The kernel sees the pixels around the box, so that windows have no seams.
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
    """Reads images of 8 bits with labels in pixels: COCO, YOLO text or DOTA text.

    Labels and sizes are read at once, pixels when somebody looks at an image.

    Args:
        folder: holds the images, or an `images` folder that does.
        labels: as `read_labels` takes them; `folder` itself where None.
        target_gsd_m: what they are resampled to, with anti-aliasing; boxes are scaled along.
        classes: names that count as vehicles; every other class becomes an ignore region.
        border_px: in a band this wide (source pixels) nothing is scored; a box whose centre lies in
            it becomes an ignore region.
        pattern: only images whose file name matches, for folders of more than one resolution or
            place.

    Raises:
        ImageryError: no images, an image that is damaged or has no labels, a class that the labels
            do not know, labels of another form, in map coordinates, of another image size or
            outside their image.
    """
    folder = Path(folder)
    files = _image_files(folder, pattern) or _image_files(folder / "images", pattern)
    if not files:
        raise ImageryError(f"{folder} holds no image matching {pattern!r}; give another folder.")
    place = Path(labels) if labels is not None else folder
    annotations = read_labels(place)
    if isinstance(annotations, GroundLabels):
        raise ImageryError(
            f"{place} has labels in map coordinates but frames such as {files[0].name} have no "
            "place on the map; give labels in pixels, or cut georeferenced imagery with "
            "`skyproof ground`."
        )
    require_classes(annotations, classes, str(place))
    pictures: list[FramePicture] = []
    boxes: list[Tensor] = []
    ignore: list[Tensor] = []
    for file in files:
        # What lies in folders of numbers, as map tiles do, may be labelled by its stem alone.
        name = image_name(file)
        name = name if name in annotations.images else file.stem
        if name not in annotations.images:
            raise ImageryError(
                f"{file} has no labels in {place}; an image without vehicles needs an empty text "
                "file or an entry."
            )
        source_size = _size_px(file)
        width, height = source_size
        stated = annotations.sizes_px.get(name, source_size)
        if stated != source_size:
            raise ImageryError(
                f"{file} has {width} x {height} px but {place} says {stated[0]} x {stated[1]}; "
                "give the images that were labelled."
            )
        of_image = annotations.images[name]
        for number, label in enumerate(of_image, 1):
            require_inside(label, source_size, f"{place}, label {number} of {name},")
        # Labels in pixels have corners, never a point alone.
        truths, ignored = sort_labels(
            of_image, classes=classes, size_px=source_size, border_px=border_px, point_box_px=0.0
        )
        size = (
            max(1, round(width * gsd_m / target_gsd_m)),
            max(1, round(height * gsd_m / target_gsd_m)),
        )
        if size[0] * size[1] > LARGEST_PX:
            raise ImageryError(
                f"{file} of {gsd_m} m per pixel would have {size[0]:,} x {size[1]:,} px at the "
                f"detector's {target_gsd_m} m, more than {LARGEST_PX:,} pixels in all; check its "
                "resolution, or cut it into smaller frames."
            )
        scale = torch.tensor([size[0] / width, size[1] / height] * 2, dtype=torch.float32)
        pictures.append(FramePicture(file, source_size, size))
        boxes.append(truths * scale)
        ignore.append(ignored * scale)
    return Dataset(
        pictures=pictures,
        boxes=boxes,
        ignore=ignore,
        ids=[file.stem for file in files],
        gsd_m=target_gsd_m,
        visible_fractions=[torch.full((len(truths),), torch.nan) for truths in boxes],
    )


def _image_files(folder: Path, pattern: str) -> list[Path]:
    return sorted(file for file in folder.glob(pattern) if file.suffix.lower() in _SUFFIXES)


def _size_px(path: Path) -> tuple[int, int]:
    """Reads width and height of an image from its header."""
    with open_picture(path, _REMEDY, error=ImageryError) as picture:
        if picture.mode[0] in "IF":
            raise ImageryError(
                f"{path} has more than 8 bits per pixel; convert it (gdal_translate -ot Byte "
                "-scale)."
            )
        return picture.size
