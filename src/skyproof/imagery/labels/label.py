"""Labels of vehicles as files give them: in pixels of named images, or on the ground."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from skyproof.datasets.coco import is_within
from skyproof.datasets.pictures import Boxes
from skyproof.errors import ImageryError
from skyproof.words import counted

Point = tuple[float, float]
Box = tuple[float, float, float, float]

UNNAMED = "vehicle"
"""The class of an object without a class name."""
_SLACK = 0.005
"""Text with few digits rounds the sides of a box by this share."""
_TELLING_BOXES = 10
"""From so many boxes on, a file is refused if most of them reach beyond their images."""


@dataclass(frozen=True)
class Label:
    """One labelled object: four corners (x, y) in order, or a point; `ignore` means not scored."""

    class_name: str
    corners: tuple[Point, ...]
    ignore: bool = False

    @classmethod
    def upright(cls, class_name: str, box: Box, ignore: bool = False) -> "Label":
        """Returns the label of a box, without size if a side comes before its opposite one."""
        left, top, right, bottom = box
        right, bottom = max(left, right), max(top, bottom)
        corners = (left, top), (right, top), (right, bottom), (left, bottom)
        return cls(class_name, corners, ignore)

    def moved(self, corners: Sequence[Point]) -> "Label":
        return dataclasses.replace(self, corners=tuple(corners))

    @property
    def bounds(self) -> Box:
        """The smallest upright box around it, xyxy; without size around a point."""
        xs, ys = zip(*self.corners, strict=True)
        return min(xs), min(ys), max(xs), max(ys)

    @property
    def length(self) -> float:
        """Its longest side."""
        return max(map(math.dist, self.corners, (*self.corners[1:], self.corners[0])))

    @property
    def middle(self) -> Point:
        left, top, right, bottom = self.bounds
        return (left + right) / 2, (top + bottom) / 2

    @property
    def is_oriented(self) -> bool:
        """Whether it has four corners that are not those of an upright box, beyond rounding."""
        left, top, right, bottom = self.bounds
        slack_x, slack_y = _SLACK * (right - left), _SLACK * (bottom - top)
        return len(self.corners) == 4 and any(
            min(x - left, right - x) > slack_x or min(y - top, bottom - y) > slack_y
            for x, y in self.corners
        )

    def corners_lengthwise(self) -> tuple[Point, ...]:
        """Returns front left, front right, rear right and rear left; a short side is the front."""
        corners = self.corners
        sides = zip(corners, (*corners[1:], corners[0]), strict=True)
        area = sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in sides)
        # With y down, a positive area means clockwise on screen, like front left, front right.
        if area < 0:
            corners = (corners[0], *reversed(corners[1:]))
        if math.dist(corners[0], corners[1]) > math.dist(corners[1], corners[2]):
            corners = (*corners[1:], corners[0])
        return corners


@dataclass(frozen=True)
class ImageLabels:
    """Labels in pixels, x right and y down from the top-left corner of the top-left pixel.

    Images are named by their files without the ending. Their widths and heights may not be known.
    Notes tell repairs. `box_form` are the numbers of a box, as the form of the labels wants them.
    """

    classes: tuple[str, ...]
    images: Mapping[str, tuple[Label, ...]]
    sizes_px: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...] = ()
    box_form: str = ""


@dataclass(frozen=True)
class GroundLabels:
    """Labels in a reference system such as "EPSG:2193", longitude or east first.

    `class_field` is the field of the file that names the classes; it is empty without one.
    """

    classes: tuple[str, ...]
    labels: tuple[Label, ...]
    crs: str
    notes: tuple[str, ...] = ()
    class_field: str = ""


Labels = ImageLabels | GroundLabels


def outline_corners(points: Sequence[Point]) -> tuple[Point, ...]:
    """Returns four points as they are, and else the corners of the upright box around all."""
    if len(points) == 4:
        return tuple(points)
    return Label.upright("", Label("", tuple(points)).bounds).corners


def twice_note(count: int, path: object) -> tuple[str, ...]:
    """Returns a note on the number of labels that repeat others to the last digit."""
    return (f"left out {counted(count, 'label')} of {path} that repeated others",) if count else ()


def flat_note(flat: Sequence[str], total: int, path: object, form: str) -> tuple[str, ...]:
    """Returns a note on boxes without width or height; labels that are mostly such are refused.

    `flat` holds the places of these boxes. torchvision and Ultralytics also leave them out, and
    boxes whose sides are exchanged.
    """
    if not flat:
        return ()
    first = flat[0].removeprefix(str(path)).lstrip("/ ")
    if 2 * len(flat) > total:
        raise ImageryError(
            f"{len(flat)} of {total} boxes of {path} have no width or height (first: {first}); "
            f"write {form}."
        )
    boxes = counted(len(flat), "box", "boxes")
    return (f"left out {boxes} of {path} without width or height (first: {first})",)


def require_classes(labels: Labels, classes: Sequence[str], where: str) -> None:
    """Refuses classes that the labels lack."""
    unknown = [name for name in classes if name not in labels.classes]
    if unknown:
        told = ("class " if len(unknown) == 1 else "classes ") + ", ".join(map(repr, unknown))
        raise ImageryError(
            f"{where} has no {told[:500]}; choose from those that it names: {told_classes(labels)}."
        )


def told_classes(labels: Labels) -> str:
    """Lists the classes, and the field of a vector file that names them."""
    known = (", ".join(labels.classes) or "none at all")[:500]
    field = labels.class_field if isinstance(labels, GroundLabels) else ""
    empty = f"; where it is empty, {UNNAMED}" if UNNAMED in labels.classes else ""
    return f"{known} (from its field {field!r}{empty})" if field else known


def require_size(
    labels: ImageLabels, name: str, size_px: tuple[int, int], image: object, where: object
) -> None:
    """Refuses labels that were made on an image of another size."""
    stated = labels.sizes_px.get(name, size_px)
    if stated == size_px:
        return
    advice = "give the images that were labelled"
    if stated == size_px[::-1]:
        advice = (
            "if they were made on the stored pixels, whose EXIF orientation is applied here, "
            "remove it (exiftool -Orientation=)"
        )
    raise ImageryError(
        f"{image} has {size_px[0]} x {size_px[1]} px but {where} says {stated[0]} x {stated[1]}; "
        f"{advice}."
    )


def cut_to_image(label: Label, size_px: tuple[int, int], where: str) -> Label:
    """Cuts an upright box at its image's edge, beyond rounding; refuses one that lies outside.

    Corners of an oriented box may reach over the edge, if its centre does not.
    """
    left, top, right, bottom = label.bounds
    width, height = size_px
    upright = _is_upright(label)
    if upright:
        inside = left < width and top < height and right > 0 and bottom > 0
    else:
        inside = 0 <= (left + right) / 2 <= width and 0 <= (top + bottom) / 2 <= height
    if not inside:
        raise ImageryError(
            f"{where} has a box outside its image of {width} x {height} px; correct it."
        )
    if not upright or is_within(label.bounds, size_px):
        return label
    corners = [(min(max(x, 0.0), float(width)), y) for x, y in label.corners]
    return label.moved([(x, min(max(y, 0.0), float(height))) for x, y in corners])


def _is_upright(label: Label) -> bool:
    left, top, right, bottom = label.bounds
    xs, ys = ({*values} for values in zip(*label.corners, strict=True))
    return len(label.corners) > 1 and xs == {left, right} and ys == {top, bottom}


def refuse_beyond_images(
    labels: ImageLabels, sizes_px: Mapping[str, tuple[int, int]], path: object
) -> None:
    """Refuses labels that mostly reach beyond images whose size only the images themselves tell."""
    placed = [
        _is_upright(label) and not is_within(label.bounds, size_px)
        for name, size_px in sizes_px.items()
        if name not in labels.sizes_px
        for label in labels.images.get(name, ())
    ]
    refuse_mostly_beyond(sum(placed), len(placed), path, labels.box_form)


def refuse_mostly_beyond(beyond: int, placed: int, path: object, box_form: str) -> None:
    """Refuses labels if most boxes, of ten or more, reach beyond their images."""
    if placed >= _TELLING_BOXES and 2 * beyond > placed:
        read = "left, top, right, bottom" if "width" in box_form else "of larger images"
        raise ImageryError(
            f"{beyond} of {placed} boxes of {path} reach beyond their images, as if they were "
            f"{read}; write {box_form}, or cut the boxes at the edge of the image."
        )


def sort_labels(
    labels: Sequence[Label],
    *,
    classes: Sequence[str],
    size_px: tuple[int, int],
    border_px: float = 0.0,
    point_box_px: float = 0.0,
) -> tuple[Boxes, Boxes]:
    """Divides the labels of one image into vehicles `[n, 4]` and ignore regions `[m, 4]`.

    Vehicles are labels of the named classes whose centre lies in the image, inside its border band.
    Every other label that touches the image becomes an ignore region, and so does the band. Boxes
    are cut at the image's edge. A point gets a box of side `point_box_px`.
    """
    (width, height), half = size_px, point_box_px / 2
    truths: list[Box] = []
    ignored: list[Box] = []
    for label in labels:
        left, top, right, bottom = label.bounds
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
        x, y = min(border_px, float(width)), min(border_px, float(height))
        ignored += [
            (0.0, 0.0, width, y),
            (0.0, height - y, width, height),
            (0.0, 0.0, x, height),
            (width - x, 0.0, width, height),
        ]
    return torch.tensor(truths).float().reshape(-1, 4), torch.tensor(ignored).float().reshape(-1, 4)
