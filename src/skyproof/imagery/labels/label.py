"""Labels of vehicles as files give them: in pixels of named images, or on the ground."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.errors import ImageryError

Point = tuple[float, float]

_MOST_PIECES = 2_000
_SLACK = 0.005
"""Label tools round, and may let a box reach over the image's edge by a pixel."""


@dataclass(frozen=True)
class Label:
    """One labelled object.

    Attributes:
        corners: four (x, y) in order around the object; one (x, y) where only its place is known.
        ignore: the file itself says that nothing is to be scored here (COCO's iscrowd, DOTA's
            difficult).
    """

    class_name: str
    corners: tuple[Point, ...]
    ignore: bool = False


@dataclass(frozen=True)
class ImageLabels:
    """Labels in pixels, x right and y down from the top-left corner of the top-left pixel.

    Attributes:
        classes: every class name the file knows, also those without an object.
        images: per image, called as `image_name` says, its labels, none for an image without
            objects; one not named was not labelled.
        sizes_px: per image its width and height, where the file or the image beside it states them.
    """

    classes: tuple[str, ...]
    images: Mapping[str, tuple[Label, ...]]
    sizes_px: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class GroundLabels:
    """Labels in map coordinates.

    Attributes:
        classes: every class name that occurs.
        labels: corners in the reference system `crs`; longitude before latitude, east before north.
        crs: as rasterio's CRS.from_user_input takes it, such as "EPSG:4326" or "EPSG:2193".
    """

    classes: tuple[str, ...]
    labels: tuple[Label, ...]
    crs: str


Labels = ImageLabels | GroundLabels


def bounds(label: Label) -> tuple[float, float, float, float]:
    """Returns the smallest upright box around a label, xyxy; of no size around a point."""
    xs, ys = zip(*label.corners, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


def is_oriented(label: Label) -> bool:
    """Tells whether a label has four corners that are not those of an upright box.

    To half a percent of its sides, as much as text with few digits rounds.
    """
    if len(label.corners) != 4:
        return False
    left, top, right, bottom = bounds(label)
    slack_x, slack_y = _SLACK * (right - left), _SLACK * (bottom - top)
    return any(
        min(x - left, right - x) > slack_x or min(y - top, bottom - y) > slack_y
        for x, y in label.corners
    )


def corners_lengthwise(label: Label) -> tuple[Point, ...]:
    """Gives the four corners of a label in pixels: front left, front right, rear right, rear left.

    Front and rear are the short sides. Labels do not say which of the two is the front: the one
    that begins with the earlier corner is taken for it.
    """
    corners = label.corners
    area = sum(
        x0 * y1 - x1 * y0
        for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True)
    )
    # With y down a positive area runs clockwise, as seen, and so do front left and front right.
    if area < 0:
        corners = (corners[0], *reversed(corners[1:]))
    if math.dist(corners[0], corners[1]) > math.dist(corners[1], corners[2]):
        corners = (*corners[1:], corners[0])
    return corners


def require_classes(labels: Labels, classes: Sequence[str], where: str) -> None:
    """Checks that the file knows every class that is to count as a vehicle.

    Raises:
        ImageryError: one it does not know; names those it does.
    """
    unknown = next((name for name in classes if name not in labels.classes), None)
    if unknown is not None:
        known = ", ".join(labels.classes) or "none at all"
        raise ImageryError(
            f"{where} has no class {unknown!r}; choose from those that it names: {known[:500]}."
        )


def require_inside(label: Label, size_px: tuple[int, int], where: str) -> None:
    """Checks that a label lies in its image.

    An upright box must do so with all of it, an oriented one with its centre.

    Args:
        where: file and line or number of the label, for the message.

    Raises:
        ImageryError: it does not, or it has no size.
    """
    left, top, right, bottom = bounds(label)
    width, height = size_px
    points = len(label.corners) == 1
    if not points and not (right > left and bottom > top):
        raise ImageryError(f"{where} has a box without size; correct it.")
    if {x for x, _ in label.corners} == {left, right} and {y for _, y in label.corners} == {
        top,
        bottom,
    }:
        slack_x, slack_y = _SLACK * width, _SLACK * height
        inside = (
            left >= -slack_x
            and top >= -slack_y
            and right <= width + slack_x
            and bottom <= height + slack_y
        )
    else:
        # Corners of an oriented box may well reach over the edge.
        inside = 0 <= (left + right) / 2 <= width and 0 <= (top + bottom) / 2 <= height
    if not inside:
        raise ImageryError(
            f"{where} has a box outside its image of {width} x {height} px; correct it."
        )


def border_strips(
    size_px: tuple[int, int], border_px: float
) -> list[tuple[float, float, float, float]]:
    """Returns the band along an image's border as boxes, pixel xyxy: top, bottom, left, right."""
    width, height = map(float, size_px)
    x = min(border_px, width)
    y = min(border_px, height)
    return [
        (0.0, 0.0, width, y),
        (0.0, height - y, width, height),
        (0.0, 0.0, x, height),
        (width - x, 0.0, width, height),
    ]


def pieces_of(
    box: tuple[float, float, float, float], side_px: float
) -> list[tuple[float, float, float, float]]:
    """Cuts a box along its longer side into pieces of about a given length."""
    left, top, right, bottom = box
    across = right - left >= bottom - top
    count = round(max(right - left, bottom - top) / side_px)
    count = min(max(count, 1), _MOST_PIECES)
    first, last = (left, right) if across else (top, bottom)
    ends = [first + (last - first) * number / count for number in range(count + 1)]
    return [
        (low, top, high, bottom) if across else (left, low, right, high)
        for low, high in itertools.pairwise(ends)
    ]


def sort_labels(
    labels: Sequence[Label],
    *,
    classes: Sequence[str],
    size_px: tuple[int, int],
    border_px: float,
    point_box_px: float,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "m 4"]]:
    """Divides the labels of one image into vehicles and regions where nothing is scored.

    Vehicles are labels of the named classes whose centre lies in the image, inside its border band.
    Every other label that touches the image becomes an ignore region. Boxes are cut at the image's
    edge; what lies beyond is dropped.

    Args:
        labels: in pixels of the image; may reach out of it, or lie outside.
        border_px: in a band this wide nothing is scored, because vehicles cut by the edge are often
            unlabelled; four ignore regions after the others. 0 for none.
        point_box_px: side of the box that stands for a point.

    Returns:
        Vehicles `[n, 4]` and ignore regions `[m, 4]`, pixel xyxy, in the order of the labels.
    """
    (width, height), half = size_px, point_box_px / 2
    truths: list[tuple[float, ...]] = []
    ignored: list[tuple[float, ...]] = []
    for label in labels:
        left, top, right, bottom = bounds(label)
        if len(label.corners) == 1:
            left, top, right, bottom = left - half, top - half, right + half, bottom + half
        x, y = (left + right) / 2, (top + bottom) / 2
        cut = max(0.0, left), max(0.0, top), min(float(width), right), min(float(height), bottom)
        if cut[0] >= cut[2] or cut[1] >= cut[3]:
            continue
        inner = border_px <= x <= width - border_px and border_px <= y <= height - border_px
        wanted = inner and not label.ignore and label.class_name in classes
        (truths if wanted else ignored).append(cut)
    if border_px:
        ignored += border_strips(size_px, border_px)
    return torch.tensor(truths).float().reshape(-1, 4), torch.tensor(ignored).float().reshape(-1, 4)
