"""Real labelled images in YOLO text form: read, brought to one resolution, ignore regions set (PAPER 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from skyproof.errors import ImageryError
from skyproof.scenes.labelled import LabelledImages

__all__ = ["read_yolo_folder"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Labels:
    """Boxes of one image in parts of its width and height, xyxy."""

    truths: list[Box]
    ignored: list[Box]


def read_yolo_folder(
    folder: Path,
    *,
    gsd_m: float,
    target_gsd_m: float,
    classes: Sequence[str],
    border_px: int = 40,
    pattern: str = "*",
) -> LabelledImages:
    """Reads images with same-named `.txt` labels (class cx cy w h, parts of the image) and one `.names` file.

    Args:
        folder: holds them all.
        gsd_m: metres per pixel of the images.
        target_gsd_m: what they are resampled to, with anti-aliasing; boxes are scaled along.
        classes: names that count as vehicles; every other class becomes an ignore region.
        border_px: in a band this wide (source pixels) nothing is scored, because vehicles cut by the border are
            often not labelled; a box whose centre lies in it becomes an ignore region.
        pattern: only images whose file name matches, for folders of more than one resolution.

    Raises:
        ImageryError: no images or names, a missing or damaged label or image, a class without a name, or a box
            outside its image.
    """
    folder = Path(folder)
    names = _names(folder)
    for name in classes:
        if name not in names:
            raise ImageryError(f"{folder} has no class {name!r}; it names {', '.join(names)}.")
    files = sorted(file for file in folder.glob(pattern) if file.suffix.lower() in SUFFIXES)
    if not files:
        raise ImageryError(f"{folder} holds no image matching {pattern!r}; give another folder.")
    images, boxes, ignore = [], [], []
    for file in files:
        picture = _picture(file)
        width, height = picture.size
        labels = _labels(file.with_suffix(".txt"), names, classes, border_px / width, border_px / height)
        band = border_px / width, border_px / height
        if border_px:
            labels.ignored.extend(
                [(0, 0, 1, band[1]), (0, 1 - band[1], 1, 1), (0, 0, band[0], 1), (1 - band[0], 0, 1, 1)]
            )
        size = max(1, round(width * gsd_m / target_gsd_m)), max(1, round(height * gsd_m / target_gsd_m))
        # Pillow widens its kernel when it shrinks, so this does not alias.
        array = np.array(picture.resize(size, Image.Resampling.BICUBIC))
        images.append(torch.from_numpy(array).permute(2, 0, 1).contiguous())
        scale = torch.tensor([size[0], size[1], size[0], size[1]], dtype=torch.float32)
        boxes.append(torch.tensor(labels.truths, dtype=torch.float32).reshape(-1, 4) * scale)
        ignore.append(torch.tensor(labels.ignored, dtype=torch.float32).reshape(-1, 4) * scale)
    return LabelledImages(
        images=images, boxes=boxes, ignore=ignore, ids=[file.stem for file in files], gsd_m=target_gsd_m
    )


def _names(folder: Path) -> list[str]:
    found = sorted(folder.glob("*.names"))
    if len(found) != 1:
        raise ImageryError(
            f"{folder} holds {len(found)} .names files but exactly one must list its classes, one a line; add it."
        )
    return [line.strip() for line in found[0].read_text(encoding="utf-8").splitlines() if line.strip()]


def _picture(path: Path) -> Image.Image:
    try:
        with Image.open(path) as picture:
            return picture.convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageryError(f"{path} cannot be read as an image ({error}); replace or remove it.") from error


def _labels(path: Path, names: list[str], classes: Sequence[str], band_x: float, band_y: float) -> _Labels:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImageryError(f"{path} is missing or unreadable; an image without vehicles needs an empty one.") from error
    labels = _Labels([], [])
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            index, centre_x, centre_y, width, height = (float(word) for word in line.split())
        except ValueError as error:
            raise ImageryError(f"{path} line {number} is not 'class cx cy w h'; correct it.") from error
        if index != int(index) or not 0 <= index < len(names):
            raise ImageryError(
                f"{path} line {number} has class {index:g} but there are {len(names)} names; correct it."
            )
        box = centre_x - width / 2, centre_y - height / 2, centre_x + width / 2, centre_y + height / 2
        # Half a percent of slack: label tools round, and may let a box reach over the edge by a pixel.
        if not (width > 0 and height > 0 and min(box) >= -0.005 and max(box) <= 1.005):
            raise ImageryError(f"{path} line {number} has a box outside its image; correct it.")
        inner = band_x <= centre_x <= 1 - band_x and band_y <= centre_y <= 1 - band_y
        clipped: Box = (max(0.0, box[0]), max(0.0, box[1]), min(1.0, box[2]), min(1.0, box[3]))
        wanted = names[int(index)] in classes and inner
        (labels.truths if wanted else labels.ignored).append(clipped)
    return labels
