"""Labels of vehicles as files give them: in pixels of named images, or in coordinates on the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["GroundLabels", "ImageLabels", "Label", "Labels"]

Point = tuple[float, float]


@dataclass(frozen=True)
class Label:
    """One labelled object.

    Attributes:
        class_name: as the file names it.
        corners: four (x, y) in order around the object; one (x, y) where only its place is known.
        ignore: the file itself says that nothing is to be scored here (COCO's iscrowd, DOTA's difficult).
    """

    class_name: str
    corners: tuple[Point, ...]
    ignore: bool = False


@dataclass(frozen=True)
class ImageLabels:
    """Labels in pixels, x right and y down from the top-left corner of the top-left pixel.

    Attributes:
        classes: every class name the file knows, also those without an object.
        images: per image file stem its labels; an image that is not named here has no labels.
        sizes_px: per image file stem its width and height, where the file states them.
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
