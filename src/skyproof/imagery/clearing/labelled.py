"""The labels of tiles to clear, and the headings of their vehicles."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.datasets.coco import ANNOTATIONS, AnnotationRow, read_annotations
from skyproof.datasets.pictures import Boxes, Pixels, window_around
from skyproof.imagery.labels.label import Point
from skyproof.scenes.places import HeadingFrom, RemovedVehicle
from skyproof.scenes.splits import SPLITS

WHOLE = 0.98
"""A vehicle with a smaller share on the tile has a box that does not show its sides."""
LONGEST_M = 30.0
"""Corners farther apart are not a vehicle's."""
STEP_RAD = math.radians(2)
LENGTH_M, LENGTH_SPREAD_M = 4.6, 0.6
WIDTH_M, WIDTH_SPREAD_M = 1.83, 0.15
BOX_SPREAD_M = 0.25
"""Mean and standard deviation of vehicles' sides, and the standard deviation of boxes."""
CORNER_M = 0.3
"""Radius of a vehicle's corners: a turned one has a smaller box."""
LINES_WEIGHT, OUTLINE_WEIGHT = 40.0, 2.0
END_SHARE = 0.4
"""Weights of lines and outline in the picture against the box, and of an end against a long side.
"""
LARGEST_MISFIT = 12.5
"""A box five standard deviations from any vehicle's holds something else."""

_Grid = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class TileLabels:
    """The labels of a tile: vehicles, objects that are not scored, and regions without labels."""

    vehicles: tuple[AnnotationRow, ...] = ()
    ignored: tuple[AnnotationRow, ...] = ()
    unlabelled: tuple[AnnotationRow, ...] = ()


def read_labels_of_tiles(folder: Path) -> dict[str, TileLabels] | None:
    """Reads the labels of every tile by id; None if the folder has none."""
    folders = [Path(folder) / split for split in SPLITS]
    labelled = [one for one in folders if (one / ANNOTATIONS).is_file()]
    labels: dict[str, TileLabels] = {}
    for one in labelled:
        document, _ = read_annotations(one)
        for image, rows in zip(document.images, document.rows_by_image, strict=True):
            labels[image.scene_id] = TileLabels(
                tuple(row for row in rows if not row.iscrowd),
                tuple(row for row in rows if row.iscrowd and not row.unlabelled),
                tuple(row for row in rows if row.unlabelled),
            )
    return labels if labelled else None


def labelled_vehicles(image: Pixels, labels: TileLabels, gsd_m: float) -> list[RemovedVehicle]:
    """Returns places and headings of labelled vehicles; one cut by the border has no heading."""
    return _on_image(image, (_labelled_vehicle(image, row, gsd_m) for row in labels.vehicles))


def detected_vehicles(image: Pixels, detected: Boxes, gsd_m: float) -> list[RemovedVehicle]:
    """Returns places and headings of detected vehicles, as `labelled_vehicles` does."""
    boxes = detected.tolist()
    found = (_pictured_vehicle(image, _between(box[:2], box[2:]), box, gsd_m) for box in boxes)
    return _on_image(image, found)


def _on_image(image: Pixels, vehicles: Iterable[RemovedVehicle]) -> list[RemovedVehicle]:
    height, width = image.shape[1:]
    return [at for at in vehicles if 0 <= at.x_px <= width and 0 <= at.y_px <= height]


def _labelled_vehicle(image: Pixels, row: AnnotationRow, gsd_m: float) -> RemovedVehicle:
    left, top, width, height = row.bbox
    middle = row.centre_px or (left + width / 2, top + height / 2)
    if row.corners_px is not None and len(row.corners_px) == 4:
        front_left, front_right, rear_right, rear_left = row.corners_px
        front, rear = _between(front_left, front_right), _between(rear_left, rear_right)
        sides = _between(front_left, rear_left), _between(front_right, rear_right)
        length_m, width_m = gsd_m * math.dist(front, rear), gsd_m * math.dist(*sides)
        if 0 < width_m <= length_m <= LONGEST_M:
            heading_rad = math.atan2(rear[1] - front[1], front[0] - rear[0]) % math.pi
            return _removed(_between(front, rear), "label", (heading_rad, length_m, width_m))
    whole = width and height and (row.visible_fraction is None or row.visible_fraction >= WHOLE)
    box = (left, top, left + width, top + height) if whole else None
    return _pictured_vehicle(image, middle, box, gsd_m)


def _pictured_vehicle(
    image: Pixels, middle: Point, box: Sequence[float] | None, gsd_m: float
) -> RemovedVehicle:
    stance = None
    # A vehicle at the border may go on beyond it.
    if box is not None and min(box[:2]) > 0 and box[2] < image.shape[2] and box[3] < image.shape[1]:
        stance = estimate_stance(image, box, gsd_m)
    return _removed(middle, None if stance is None else "picture", stance)


def _removed(
    middle: Point, heading_from: HeadingFrom | None, stance: tuple[float, float, float] | None
) -> RemovedVehicle:
    """Makes a record of a vehicle, rounded to a millimetre and a ten-thousandth of a radian."""
    x_px, y_px = (round(value, 2) for value in middle)
    if stance is None:
        return RemovedVehicle(x_px, y_px, None, heading_from)
    heading_rad, *sides_m = stance
    length_m, width_m = (round(side_m, 3) for side_m in sides_m)
    return RemovedVehicle(x_px, y_px, round(heading_rad, 4), heading_from, length_m, width_m)


def _between(first: Point, second: Point) -> Point:
    return (first[0] + second[0]) / 2, (first[1] + second[1]) / 2


def estimate_stance(
    image: Pixels, box: Sequence[float], gsd_m: float
) -> tuple[float, float, float] | None:
    """Estimates heading, length and width of a vehicle from an upright box around it, pixel xyxy.

    The heading is the one, in steps of 2 degrees, whose rectangle fits best: the box around it must
    have the given width and height (w = l |cos| + b |sin|, less rounded corners), its sides must be
    a small vehicle's, lines in the box must run along or across it, as sides, roof and panes do,
    and the picture must have edges along its outline. Lines are exact, but only the outline tells
    along from across. Errors: docs/imagery.md. The heading runs from x (right) towards up, modulo
    pi. None: the box fits no small vehicle.
    """
    left, top, right, bottom = box
    width_m, height_m = (right - left) * gsd_m, (bottom - top) * gsd_m
    headings = np.arange(0, math.pi, STEP_RAD)
    lengths, widths, misfits = _sides(headings, width_m, height_m)
    if misfits.min() > LARGEST_MISFIT:
        return None
    lines, outline = _edges(image, box, gsd_m, headings, lengths, widths)
    best = int((LINES_WEIGHT * lines + OUTLINE_WEIGHT * outline - misfits).argmax())
    return float(headings[best]), float(lengths[best]), float(widths[best])


def _sides(headings: _Grid, width_m: float, height_m: float) -> tuple[_Grid, _Grid, _Grid]:
    """Returns the most likely length and width for each heading, and half their squared misfit."""
    cosine, sine = np.abs(np.cos(headings)), np.abs(np.sin(headings))
    saved_m = 2 * CORNER_M * (cosine + sine - 1)
    square = abs(width_m - height_m) < 1e-3 * width_m
    spread_m = 1e6 if square else BOX_SPREAD_M
    wide, high = width_m + saved_m, height_m + saved_m
    # The normal equations of two unknowns, solved by Cramer's rule.
    trust = 1 / spread_m**2
    of_length, of_width = 1 / LENGTH_SPREAD_M**2, 1 / WIDTH_SPREAD_M**2
    a = trust + of_length
    b = 2 * trust * cosine * sine
    c = trust + of_width
    p = trust * (cosine * wide + sine * high) + of_length * LENGTH_M
    q = trust * (sine * wide + cosine * high) + of_width * WIDTH_M
    lengths = (c * p - b * q) / (a * c - b * b)
    widths = (a * q - b * p) / (a * c - b * b)
    misfits = trust * (
        (lengths * cosine + widths * sine - wide) ** 2
        + (lengths * sine + widths * cosine - high) ** 2
    )
    misfits += of_length * (lengths - LENGTH_M) ** 2 + of_width * (widths - WIDTH_M) ** 2
    return lengths, widths, misfits / 2


def _edges(
    image: Pixels,
    box: Sequence[float],
    gsd_m: float,
    headings: _Grid,
    lengths: _Grid,
    widths: _Grid,
) -> tuple[_Grid, _Grid]:
    """Measures how well lines in the box run along or across each heading, from -1 to 1.

    It also returns the change across each rectangle's outline, relative to the change in the box.
    """
    left, top, right, bottom = box
    rows, columns = window_around((left, top, right, bottom), 1.2 / gsd_m, image.shape[1:])
    part = image[:, rows, columns].numpy().astype(np.float64) / 255
    part = ndimage.gaussian_filter(part, (0, 0.7, 0.7))
    down, across = ndimage.sobel(part, 1) / 8, ndimage.sobel(part, 2) / 8
    xx, yy, xy = (across**2).sum(0), (down**2).sum(0), (across * down).sum(0)
    inner = (left - columns.start, top - rows.start, right - columns.start, bottom - rows.start)
    within = window_around(inner, 0.0, part.shape[1:])
    usual = math.sqrt(float((xx + yy)[within].mean())) + 1e-6
    # Four times the angle makes along and across the same. Weak lines count, too.
    turned = (xx - yy + 2j * xy)[within]
    strengths = np.sqrt(np.abs(turned)) + 1e-12
    mean = (turned**2 / strengths**3).sum() / strengths.sum()
    # The angle of a change has y down.
    lines = (mean * np.exp(4j * headings)).real
    # Points along the four sides, as shares of length and width.
    steps = np.linspace(-0.42, 0.42, 25)
    half = np.full_like(steps, 0.5)
    sides = [(steps, half, False), (steps, -half, False), (half, steps, True), (-half, steps, True)]
    total = np.zeros(len(headings))
    cosine, sine = np.cos(headings)[:, None], np.sin(headings)[:, None]
    for along, aside, is_end in sides:
        u_px = lengths[:, None] * along / gsd_m
        v_px = widths[:, None] * aside / gsd_m
        x = (left + right) / 2 + cosine * u_px - sine * v_px
        y = (top + bottom) / 2 - sine * u_px - cosine * v_px
        # The normal, with y down: along the heading at an end, across it at a long side.
        normal = (cosine, -sine) if is_end else (-sine, -cosine)
        places = [y - 0.5 - rows.start, x - 0.5 - columns.start]
        change_xx, change_yy, change_xy = (
            ndimage.map_coordinates(product, places, order=1, mode="nearest")
            for product in (xx, yy, xy)
        )
        change = normal[0] ** 2 * change_xx + normal[1] ** 2 * change_yy
        change = change + 2 * normal[0] * normal[1] * change_xy
        strength = np.sqrt(np.maximum(change, 0)).mean(1) / usual
        total += (END_SHARE if is_end else 1.0) * strength
    return lines, total / (2 + 2 * END_SHARE)
