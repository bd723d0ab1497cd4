"""Takes labels to the ground that tiles are cut from, and from there onto the tiles."""

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from rasterio.crs import CRS

from skyproof.datasets.coco import Annotation
from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import (
    GroundLabels,
    ImageLabels,
    Label,
    Labels,
    refuse_beyond_images,
    require_classes,
    require_size,
    sort_labels,
    told_classes,
)
from skyproof.imagery.notes import ImageNote
from skyproof.imagery.settings import LabelSettings
from skyproof.imagery.tiles.georeference import system_of, to_reference_system
from skyproof.imagery.tiles.grid import Cell, Extent, around, extent_of
from skyproof.imagery.tiles.sources import Source
from skyproof.words import counted, named

BIN_M = 64.0
FARTHEST_PX = 1e6
EVERYTHING = "image without labels"
POINT_BOX_M = 4.0
"""Side of a point label's box: that of a car's upright box at a random heading."""


@dataclass
class _Plane:
    """A system of coordinates with the numbers of its sources and the extent of its cells."""

    crs: CRS | None
    sources: set[int]
    extent: Extent


@dataclass(frozen=True)
class _Placed:
    """A label in a plane, the number of its only source, and whether it is turned."""

    label: Label
    source: int | None
    oriented: bool = False


class PlacedLabels:
    """Labels in the coordinates of the tiles; `notes` tell which labels and images were left out.

    A vehicle counts on the tile of its centre, if its source has data there, and is an ignore
    region on others. Labels in pixels count only on pixels of their own source. An image without
    any entry in the labels, or without a place on their map, is ignored.
    """

    def __init__(
        self,
        labels: Labels,
        settings: LabelSettings,
        sources: Sequence[Source],
        cells: Sequence[Cell],
    ) -> None:
        self._classes = vehicle_classes(labels, settings)
        self._settings, self._sources = settings, sources
        self._bins: dict[tuple[str, int, int], list[_Placed]] = defaultdict(list)
        self._planes: dict[str, _Plane] = {}
        self.notes = [*labels.notes]
        for cell in cells:
            plane = self._planes.setdefault(cell.plane, _Plane(cell.crs, set(), cell.extent))
            plane.sources.update(cell.sources)
            plane.extent = around([plane.extent, cell.extent])
        if isinstance(labels, GroundLabels):
            outside = self._place_ground(labels)
        else:
            outside = self._place_pixels(labels)
        if outside:
            self.notes.append(
                f"left out {counted(outside, 'label')} of {settings.path} outside the imagery"
            )

    def _place_ground(self, labels: GroundLabels) -> int:
        """Places labels on the ground; returns how many lie outside the imagery."""
        path = self._settings.path
        if all(plane.crs is None for plane in self._planes.values()):
            raise ImageryError(
                f"{path} gives labels in map coordinates but no image says where it lies; give "
                "georeferenced imagery."
            )
        system = system_of(labels.crs, path)
        inside = np.zeros(len(labels.labels), bool)
        bare: list[str] = []
        flat = [corner for label in labels.labels for corner in label.corners]
        for name, plane in self._planes.items():
            if plane.crs is None:
                # Labels on a map say nothing about an image that has no place on it.
                for number in sorted(plane.sources):
                    self._add_unlabelled(name, number)
                continue
            corners = iter(to_reference_system(system, plane.crs, flat))
            moved = [label.moved([next(corners) for _ in label.corners]) for label in labels.labels]
            middles = np.array([label.middle for label in moved])
            for number in sorted(plane.sources):
                extent = np.reshape(extent_of(self._sources[number], plane.crs), (2, 2))
                in_source = ((middles >= extent[0]) & (middles <= extent[1])).all(1)
                if not in_source.any():
                    bare.append(self._sources[number].path.name)
                inside |= in_source
            for label, original in zip(moved, labels.labels, strict=True):
                self._add(name, _Placed(label, None, original.is_oriented))
        if len(inside) and not inside.any():
            raise ImageryError(
                f"None of the {len(inside)} labels of {path} lies in the imagery; check their "
                f"reference system ({labels.crs} as read) and whether they belong to it."
            )
        if bare:
            self.notes.append(
                f"no label of {path} lies in {named(bare, 'image')} of {len(self._sources)}, which "
                "counts as free of vehicles; leave out images where nobody looked for any"
            )
        return int((~inside).sum())

    def _place_pixels(self, labels: ImageLabels) -> int:
        """Places labels in pixels; returns how many lie outside the imagery."""
        path = self._settings.path
        sizes_px = {each.path.stem: (each.width_px, each.height_px) for each in self._sources}
        unknown = [name for name in labels.images if name not in sizes_px]
        total = sum(map(len, labels.images.values()))
        outside = sum(len(labels.images[name]) for name in unknown)
        if labels.images and len(unknown) == len(labels.images):
            raise ImageryError(
                f"The {total} labels of {path} belong to {len(unknown)} images ({unknown[0]}, ...) "
                "and none of these is among the imagery; check the names."
            )
        refuse_beyond_images(labels, sizes_px, path)
        planes = self._planes.items()
        for plane, number in [(name, one) for name, its in planes for one in sorted(its.sources)]:
            source = self._sources[number]
            name, size_px = source.path.stem, (source.width_px, source.height_px)
            if name not in labels.images:
                self._add_unlabelled(plane, number)
                continue
            require_size(labels, name, size_px, source.path, path)
            for label in labels.images[name]:
                x, y = label.middle
                if 0 <= x <= size_px[0] and 0 <= y <= size_px[1]:
                    moved = self._to_plane(plane, label, number)
                    self._add(plane, _Placed(moved, number, label.is_oriented))
                else:
                    outside += 1
        if total and outside == total:
            raise ImageryError(
                f"None of the {total} labels of {path} lies in its image; check whether they are "
                "given in pixels of these images."
            )
        return outside

    def _to_plane(self, plane: str, label: Label, number: int) -> Label:
        georeference = self._sources[number].georeference
        corners = [georeference.transform * corner for corner in label.corners]
        return label.moved(to_reference_system(georeference.crs, self._planes[plane].crs, corners))

    def _add_unlabelled(self, plane: str, number: int) -> None:
        """Makes a source that nobody labelled one ignore region."""
        source = self._sources[number]
        told = "no labels, so nothing is scored on its tiles"
        self.notes.append(ImageNote(source.path.name, told))
        whole = (0.0, 0.0, float(source.width_px), float(source.height_px))
        label = self._to_plane(plane, Label.upright(EVERYTHING, whole, ignore=True), number)
        self._add(plane, _Placed(label, number))

    def _add(self, plane: str, item: _Placed) -> None:
        reach = POINT_BOX_M / 2
        left, bottom, right, top = self._planes[plane].extent
        first_x, first_y, last_x, last_y = item.label.bounds
        if not all(math.isfinite(value) for corner in item.label.corners for value in corner):
            return
        # A label may reach around the world, but only bins of cells are read.
        columns = _bins(max(first_x - reach, left), min(last_x + reach, right))
        rows = _bins(max(first_y - reach, bottom), min(last_y + reach, top))
        for column, row in itertools.product(columns, rows):
            self._bins[plane, column, row].append(item)

    def on(self, cell: Cell, owner: Int[np.ndarray, "S S"]) -> list[Annotation]:
        """Returns vehicles and ignore regions of a tile; `owner` is the source of each pixel."""
        left, bottom, right, top = cell.extent
        near: dict[int, _Placed] = {}
        for place in itertools.product(_bins(left, right), _bins(bottom, top)):
            near |= {id(item): item for item in self._bins.get((cell.plane, *place), ())}
        annotations = (self._annotation(item, cell, owner) for item in near.values())
        return [annotation for annotation in annotations if annotation is not None]

    def _annotation(
        self, item: _Placed, cell: Cell, owner: Int[np.ndarray, "S S"]
    ) -> Annotation | None:
        label = item.label.moved([~cell.transform * corner for corner in item.label.corners])
        size = cell.size_px
        x, y = label.middle
        unlabelled, ignore = label.class_name == EVERYTHING, label.ignore
        if unlabelled and not (owner == item.source).any():
            return None
        if not unlabelled:
            shown = int(owner[min(max(int(y), 0), size - 1), min(max(int(x), 0), size - 1)])
            if item.source is not None and shown not in (item.source, -1):
                return None
            ignore |= not (0 <= x < size and 0 <= y < size) or shown < 0
        point_box_px = POINT_BOX_M / cell.gsd_m
        shown_as = Label(label.class_name, label.corners, ignore)
        truths, ignored = sort_labels(
            [shown_as], classes=self._classes, size_px=(size, size), point_box_px=point_box_px
        )
        if not len(truths) + len(ignored):
            return None
        box = left, top, right, bottom = tuple(torch.cat([truths, ignored])[0].tolist())
        if not len(truths):
            middle = ((left + right) / 2, (top + bottom) / 2)
            return Annotation(box, middle, ignore=True, unlabelled=unlabelled)
        first_x, first_y, last_x, last_y = label.bounds
        area_px = (last_x - first_x) * (last_y - first_y)
        if len(label.corners) == 1:
            area_px = point_box_px**2
        # Corners farther away are those of no vehicle, and nothing could be drawn with them.
        near = all(abs(value) <= FARTHEST_PX for corner in label.corners for value in corner)
        visible = min((right - left) * (bottom - top) / max(area_px, 1e-9), 1.0)
        corners_px = label.corners_lengthwise() if item.oriented and near else None
        return Annotation(box, (x, y), visible, corners_px=corners_px)


def _bins(low_m: float, high_m: float) -> range:
    return range(math.floor(low_m / BIN_M), math.floor(high_m / BIN_M) + 1)


def vehicle_classes(labels: Labels, settings: LabelSettings) -> tuple[str, ...]:
    """Returns the classes that are vehicles; with several classes a choice is needed."""
    if settings.classes:
        require_classes(labels, settings.classes, str(settings.path))
        return settings.classes
    if len(labels.classes) > 1:
        raise ImageryError(
            f"{settings.path} names the classes {told_classes(labels)}; say with "
            "--labels.classes which of them count as vehicles (small vehicles in the paper)."
        )
    return labels.classes
