"""The labels of tiles that are cleared: vehicles with what is known of them, and ignore regions."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.datasets.annotations import (
    ANNOTATIONS,
    AnnotationFile,
    AnnotationRow,
    read_annotations,
)
from skyproof.imagery.clearing.heading import estimate_stance
from skyproof.ranges import Coordinate
from skyproof.scenes.places import HeadingFrom, RemovedVehicle
from skyproof.scenes.splits import SPLITS

Point = tuple[float, float]
Box = tuple[float, float, float, float]

WHOLE = 0.98
"""A box of which less lies on the tile says nothing of the vehicle's sides."""
LONGEST_M = 30.0
"""Corners farther apart are not a vehicle's."""


class _Row(AnnotationRow, kw_only=True, frozen=True):
    """An annotation with the vehicle's middle, and its corners on the ground where known.

    An unlabelled region is no object: nobody looked for vehicles there.
    """

    centre_px: tuple[Coordinate, Coordinate] | None = None
    corners_px: tuple[tuple[Coordinate, Coordinate], ...] | None = None
    unlabelled: bool = False


class _File(AnnotationFile, kw_only=True, frozen=True):
    annotations: tuple[_Row, ...]


@dataclass(frozen=True)
class TileLabels:
    """What is labelled on a tile.

    Attributes:
        ignored: objects that are not scored, other vehicles among them.
        unlabelled: regions where nobody looked for vehicles.
    """

    vehicles: tuple[_Row, ...] = ()
    ignored: tuple[_Row, ...] = ()
    unlabelled: tuple[_Row, ...] = ()

    @property
    def boxes(self) -> Float[Tensor, "n 4"]:
        """The boxes of all objects, vehicles first, pixel xyxy."""
        return _boxes([*self.vehicles, *self.ignored])

    @property
    def unlabelled_boxes(self) -> Float[Tensor, "n 4"]:
        """The regions where vehicles may stand that are not labelled, pixel xyxy."""
        return _boxes(self.unlabelled)

    @property
    def vehicle_boxes(self) -> Float[Tensor, "n 4"]:
        """The boxes of the vehicles alone."""
        return _boxes(self.vehicles)


def read_labels_of_tiles(folder: Path) -> dict[str, TileLabels] | None:
    """Reads the labels of every tile id; None where the folder has no labels.

    Raises:
        StoredFileError: an annotation file is damaged.
    """
    folders = [Path(folder) / split for split in SPLITS]
    labelled = [one for one in folders if (one / ANNOTATIONS).is_file()]
    if not labelled:
        return None
    labels: dict[str, TileLabels] = {}
    for one in labelled:
        document, _ = read_annotations(one, _File)
        rows: dict[int, list[_Row]] = defaultdict(list)
        for row in document.annotations:
            rows[row.image_id].append(row)
        for image in document.images:
            labels[image.scene_id] = TileLabels(
                tuple(row for row in rows[image.id] if not row.iscrowd),
                tuple(row for row in rows[image.id] if row.iscrowd and not row.unlabelled),
                tuple(row for row in rows[image.id] if row.unlabelled),
            )
    return labels


def removed_vehicles(
    image: UInt8[Tensor, "3 H W"], labels: TileLabels, detected: Float[Tensor, "n 4"], gsd_m: float
) -> tuple[RemovedVehicle, ...]:
    """Says where and how the vehicles of a tile stand, before they are removed.

    Headings come from oriented labels, else from the picture (`estimate_stance`); those of vehicles
    that the tile's border cuts are not known. Ignore regions are no vehicles.

    Args:
        image: the tile, sRGB bytes.
        detected: boxes of vehicles that nobody labelled, pixel xyxy.
    """
    places = [_labelled_vehicle(image, row, gsd_m) for row in labels.vehicles]
    for left, top, right, bottom in detected.tolist():
        middle = ((left + right) / 2, (top + bottom) / 2)
        places.append(_pictured_vehicle(image, middle, (left, top, right, bottom), gsd_m))
    return tuple(
        place
        for place in places
        if 0 <= place.x_px <= image.shape[2] and 0 <= place.y_px <= image.shape[1]
    )


def _labelled_vehicle(image: UInt8[Tensor, "3 H W"], row: _Row, gsd_m: float) -> RemovedVehicle:
    left, top, width, height = row.bbox
    middle = row.centre_px or (left + width / 2, top + height / 2)
    if row.corners_px is not None and len(row.corners_px) == 4:
        front_left, front_right, rear_right, rear_left = row.corners_px
        front, rear = _between(front_left, front_right), _between(rear_left, rear_right)
        length_m = gsd_m * math.dist(front, rear)
        width_m = gsd_m * math.dist(
            _between(front_left, rear_left), _between(front_right, rear_right)
        )
        if 0 < width_m <= length_m <= LONGEST_M:
            heading_rad = math.atan2(rear[1] - front[1], front[0] - rear[0]) % math.pi
            stance = (heading_rad, length_m, width_m)
            return _removed(_between(front, rear), "label", stance)
    whole = width and height and (row.visible_fraction is None or row.visible_fraction >= WHOLE)
    box = (left, top, left + width, top + height) if whole else None
    return _pictured_vehicle(image, middle, box, gsd_m)


def _pictured_vehicle(
    image: UInt8[Tensor, "3 H W"], middle: Point, box: Box | None, gsd_m: float
) -> RemovedVehicle:
    stance = None
    # What touches the border may go on beyond it.
    if box is not None and min(box[:2]) > 0 and box[2] < image.shape[2] and box[3] < image.shape[1]:
        stance = estimate_stance(image, box, gsd_m)
    return _removed(middle, None if stance is None else "picture", stance)


def _removed(
    middle: Point, heading_from: HeadingFrom | None, stance: tuple[float, float, float] | None
) -> RemovedVehicle:
    """Makes a record of a vehicle; a millimetre and a ten-thousandth of a radian are kept."""
    x_px, y_px = (round(value, 2) for value in middle)
    heading_rad, length_m, width_m = (None,) * 3 if stance is None else stance
    return RemovedVehicle(
        x_px,
        y_px,
        None if heading_rad is None else round(heading_rad, 4),
        heading_from,
        None if length_m is None else round(length_m, 3),
        None if width_m is None else round(width_m, 3),
    )


def _between(first: Point, second: Point) -> Point:
    return (first[0] + second[0]) / 2, (first[1] + second[1]) / 2


def _boxes(rows: Sequence[_Row]) -> Float[Tensor, "n 4"]:
    boxes = torch.tensor([row.bbox for row in rows], dtype=torch.float32).reshape(-1, 4)
    return torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)
