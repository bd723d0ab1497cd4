"""Reads labels as COCO: boxes, or else outlines and masks."""

import itertools
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Annotated

import msgspec
from msgspec import Meta

from skyproof.documents import parse_document, read_document
from skyproof.errors import ImageryError
from skyproof.imagery.labels.image_files import LabelledImages, damaged
from skyproof.imagery.labels.label import Box, ImageLabels, Label, Point, outline_corners
from skyproof.ranges import Coordinate

# Tools count, also in floats, or name every row.
_Id = (
    Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
    | Annotated[float, Meta(ge=-(2**63), le=2**63)]
    | Annotated[str, Meta(max_length=200)]
)
_ImageSize = Annotated[float, Meta(ge=0, le=1e6)]
_Side = Annotated[int, Meta(ge=1, le=10**6)]
_Run = Annotated[int, Meta(ge=0, le=10**12)]
_LONGEST_RUN_LETTERS = 13
"""Letters of five bits each, for 64 bits."""


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
    # Some writers leave it empty and give a segmentation.
    bbox: list[Coordinate] | None = None
    # Read only where there is no box.
    segmentation: msgspec.Raw = msgspec.Raw()
    id: _Id | None = None
    iscrowd: bool | Annotated[float, Meta(ge=0, le=1)] = 0


class _RunLengths(msgspec.Struct):
    """Numbers of pixels, column by column, outside and inside an object in turn."""

    size: tuple[_Side, _Side]
    counts: list[_Run] | str


class _Outlined(msgspec.Struct):
    segmentation: list[list[Coordinate]] | _RunLengths


class _CocoFile(msgspec.Struct):
    categories: list[_CocoCategory]
    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


def read_coco_labels(path: Path) -> ImageLabels:
    """Reads categories, images and boxes of a COCO file; crowds become ignore regions.

    Without a box, the outline counts, with its corners if it has four, or else the mask.
    """
    document: _CocoFile = read_document(path, _CocoFile, "correct it", error=ImageryError)
    categories = {row.id: row.name for row in document.categories}
    images = LabelledImages(path, "left, top, width, height in pixels")
    names: dict[float | str, str] = {}
    for image in document.images:
        # Only the name in a path is used; no file is opened.
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
            raise damaged(where, f"has category {row.category_id} but the file lists {known[:500]}")
        name, class_name, ignore = names[row.image_id], categories[row.category_id], row.iscrowd
        if row.bbox:
            if len(row.bbox) != 4:
                raise damaged(where, f"has a bbox of {len(row.bbox)} numbers, not 4")
            left, top, width, height = row.bbox
            label = Label.upright(class_name, (left, top, left + width, top + height), bool(ignore))
        else:
            corners = _outline(row.segmentation, images.sizes_px.get(name), where)
            label = Label(class_name, corners, bool(ignore))
        images.add(name, label, where)
    return images.with_classes(dict.fromkeys(categories.values()))


def _outline(
    segmentation: msgspec.Raw, size_px: tuple[int, int] | None, where: str
) -> tuple[Point, ...]:
    """Returns the corners of the only polygon if it has four, or else of the box around all."""
    if bytes(segmentation) in (b"", b"null"):
        raise damaged(where, "has neither a bbox nor a segmentation")
    text = b'{"segmentation":' + bytes(segmentation) + b"}"
    outlined: _Outlined = parse_document(text, _Outlined, where, "correct it", error=ImageryError)
    its = outlined.segmentation
    if isinstance(its, list):
        if not its or any(len(polygon) < 6 or len(polygon) % 2 for polygon in its):
            raise damaged(where, "has a segmentation that is not lists of x1, y1, ... xn, yn")
        points = [point for each in its for point in zip(each[::2], each[1::2], strict=True)]
        return outline_corners(points)
    if size_px is not None and tuple(its.size) != size_px[::-1]:
        height, width = its.size
        what = f"has a mask of {width} x {height} px but its image {size_px[0]} x {size_px[1]}"
        raise damaged(where, what)
    try:
        runs = _runs(its.counts) if isinstance(its.counts, str) else its.counts
        return Label.upright("", _box_of(runs, its.size)).corners
    except ValueError as error:
        raise damaged(where, f"has a mask whose run lengths {error}") from error


def _runs(text: str) -> list[int]:
    """Decodes the run lengths of pycocotools.

    A letter, counted from "0", holds five bits of a number, the lowest first, and a sixth bit that
    tells whether more follow. From the fourth number on, the text holds the difference from the
    number two before. The decoder of pycocotools itself reads beyond the end of a damaged text.
    """
    runs: list[int] = []
    value = letters = 0
    for letter in text:
        bits = ord(letter) - ord("0")
        if not 0 <= bits < 64 or letters == _LONGEST_RUN_LETTERS:
            raise ValueError("cannot be decoded")
        value |= (bits & 31) << 5 * letters
        letters += 1
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << 5 * letters
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = letters = 0
    if letters or any(run < 0 for run in runs):
        raise ValueError("cannot be decoded")
    return runs


def _box_of(runs: Sequence[int], size: tuple[int, int]) -> Box:
    """Returns the box around the pixels of every second run; it has no size without a pixel."""
    height, width = size
    ends = [*itertools.accumulate(runs)]
    if not ends or ends[-1] != height * width:
        raise ValueError(f"do not fill {width} x {height} px")
    spans = [(end - run, end - 1) for run, end in zip(runs[1::2], ends[1::2], strict=True) if run]
    if not spans:
        return 0.0, 0.0, 0.0, 0.0
    columns = [(first // height, last // height) for first, last in spans]
    left, right = min(first for first, _ in columns), max(last for _, last in columns) + 1
    top, bottom = min(first % height for first, _ in spans), max(last % height for _, last in spans)
    if any(first != last for first, last in columns):
        # A run goes on from the lowest pixel of a column to the highest of the next.
        top, bottom = 0, height - 1
    return float(left), float(top), float(right), bottom + 1.0
