"""Takes labels to the ground that tiles are cut from, and from there onto the tiles."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from rasterio.crs import CRS

from skyproof.datasets.coco import Annotation
from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import (
    GroundLabels,
    ImageLabels,
    Label,
    Labels,
    border_strips,
    corners_lengthwise,
    is_oriented,
    pieces_of,
    require_classes,
    sort_labels,
)
from skyproof.imagery.settings import LabelSettings
from skyproof.imagery.tiles.georeference import Point, image_name, system_of, to_reference_system
from skyproof.imagery.tiles.grid import Cell, Extent, extent_of, plane_of
from skyproof.imagery.tiles.sources import Source

BIN_M = 64.0
FARTHEST_PX = 1e6
_NAMED = 3
EVERYTHING, BORDER = "image without labels", "border of an image"


@dataclass(frozen=True)
class _Placed:
    """A label in the coordinates of a plane.

    Attributes:
        source: where it belongs to one source alone.
        oriented: whether it is turned as the vehicle is, and not upright in its file.
    """

    label: Label
    source: int | None
    oriented: bool = False


class PlacedLabels:
    """Labels in the coordinates of the tiles.

    A vehicle counts on the tile that its centre lies in, with its box cut at the tile's border; on
    the tiles beside it, and where the source has no data at its centre, it is an ignore region.
    Of an oriented label the corners are kept beside the box.
    Labels in pixels count only where their own source is what the tile shows. What an image without
    any entry in the labels shows is ignored as a whole: nobody looked for vehicles there. So is an
    image without georeference where labels lie on the map.

    Attributes:
        outside: labels that lie outside all imagery.
        notes: what was left out, a sentence each.

    Raises:
        ImageryError: a class no label knows, labels made for images of another size, or no label in
            the imagery.
    """

    def __init__(
        self,
        labels: Labels,
        settings: LabelSettings,
        sources: Sequence[Source],
        cells: Sequence[Cell],
    ) -> None:
        self._classes = _vehicle_classes(labels, settings)
        self._settings, self._sources = settings, sources
        self._bins: dict[tuple[str, int, int], list[_Placed]] = defaultdict(list)
        self.notes: list[str] = []
        planes: dict[str, tuple[CRS | None, set[int]]] = {}
        self._extents: dict[str, Extent] = {}
        for cell in cells:
            plane = plane_of(cell.crs, cell.sources)
            planes.setdefault(plane, (cell.crs, set()))[1].update(cell.sources)
            own = cell.extent
            low, high = self._extents.get(plane, own)[:2], self._extents.get(plane, own)[2:]
            self._extents[plane] = (
                min(low[0], own[0]),
                min(low[1], own[1]),
                max(high[0], own[2]),
                max(high[1], own[3]),
            )
        if isinstance(labels, GroundLabels):
            self.outside = self._place_ground(labels, planes)
        else:
            self.outside = self._place_pixels(labels, planes)
        if self.outside:
            self.notes.append(
                f"{self.outside} labels of {settings.path} lie outside the imagery and are left out"
            )
        if settings.border_px:
            for plane, (crs, numbers) in planes.items():
                for number in numbers:
                    self._add_border(plane, crs, number)

    def _place_ground(
        self, labels: GroundLabels, planes: dict[str, tuple[CRS | None, set[int]]]
    ) -> int:
        path = self._settings.path
        count = len(labels.labels)
        if all(crs is None for crs, _ in planes.values()):
            raise ImageryError(
                f"{path} gives labels in map coordinates but no image says where it lies; give "
                "georeferenced imagery."
            )
        system = system_of(labels.crs, path)
        inside = np.zeros(count, bool)
        bare: list[str] = []
        flat = [corner for label in labels.labels for corner in label.corners]
        for plane, (crs, numbers) in planes.items():
            if crs is None:
                # Labels on the map say nothing of an image that is not on it.
                for number in sorted(numbers):
                    self._add_unlabelled(plane, crs, number)
                continue
            corners = iter(to_reference_system(system, crs, flat))
            moved = [
                dataclasses.replace(label, corners=tuple(next(corners) for _ in label.corners))
                for label in labels.labels
            ]
            middles = np.array([_middle(label) for label in moved])
            in_plane = np.zeros(count, bool)
            for number in sorted(numbers):
                in_source = _within(middles, extent_of(self._sources[number], crs))
                if not in_source.any():
                    bare.append(self._sources[number].path.name)
                in_plane |= in_source
            inside |= in_plane
            placed = (
                _Placed(label, None, is_oriented(original))
                for label, original in zip(moved, labels.labels, strict=True)
            )
            self._add(plane, (one for one in placed if math.isfinite(sum(_middle(one.label)))))
        if count and not inside.any():
            raise ImageryError(
                f"None of the {count} labels of {path} lies in the imagery; check their reference "
                f"system ({labels.crs} as read) and whether they belong to it."
            )
        if bare:
            self.notes.append(
                f"no label of {path} lies in {len(bare)} of {len(self._sources)} images "
                f"({', '.join(bare[:_NAMED])}{', ...' if len(bare) > _NAMED else ''}): they count "
                "as free of vehicles; leave out those where nobody looked for any"
            )
        return int(count - inside.sum())

    def _place_pixels(
        self, labels: ImageLabels, planes: dict[str, tuple[CRS | None, set[int]]]
    ) -> int:
        path = self._settings.path
        known = {image_name(source.path) for source in self._sources}
        unknown = [name for name in labels.images if name not in known]
        total = sum(map(len, labels.images.values()))
        outside = sum(len(labels.images[name]) for name in unknown)
        if labels.images and len(unknown) == len(labels.images):
            raise ImageryError(
                f"The {total} labels of {path} belong to {len(unknown)} images ({unknown[0]}, ...) "
                "and none of these is among the imagery; check the names."
            )
        for plane, (crs, numbers) in planes.items():
            for number in sorted(numbers):
                source = self._sources[number]
                name, size = image_name(source.path), (source.width_px, source.height_px)
                if name not in labels.images:
                    self._add_unlabelled(plane, crs, number)
                    continue
                if labels.sizes_px.get(name, size) != size:
                    raise ImageryError(
                        f"{path} was made for {name} of {labels.sizes_px[name]} px but "
                        f"{source.path} has {size} px; give the image the labels were made on."
                    )
                labels_here = labels.images[name]
                kept = [label for label in labels_here if _inside_picture(_middle(label), size)]
                outside += len(labels_here) - len(kept)
                self._add(
                    plane,
                    (
                        _Placed(self._to_plane(label, number, crs), number, is_oriented(label))
                        for label in kept
                    ),
                )
        if total and outside == total:
            raise ImageryError(
                f"None of the {total} labels of {path} lies in its image; check whether they are "
                "given in pixels of these images."
            )
        return outside

    def _to_plane(self, label: Label, number: int, crs: CRS | None) -> Label:
        georeference = self._sources[number].georeference
        corners = [georeference.transform * corner for corner in label.corners]
        return dataclasses.replace(
            label, corners=tuple(to_reference_system(georeference.crs, crs, corners))
        )

    def _add_unlabelled(self, plane: str, crs: CRS | None, number: int) -> None:
        """Notes that nobody looked for vehicles on a source: nothing is scored there."""
        source = self._sources[number]
        self.notes.append(f"{source.path.name} has no labels: nothing is scored on its tiles")
        whole = (0.0, 0.0, float(source.width_px), float(source.height_px))
        self._add_regions(plane, crs, number, EVERYTHING, [whole])

    def _add_border(self, plane: str, crs: CRS | None, number: int) -> None:
        """Adds the band along the border of a source, in pieces where it does not stay upright.

        On a tile a region is the upright box around it: of a strip that lies aslant it would cover
        much of the source.
        """
        source, border_px = self._sources[number], self._settings.border_px
        strips = border_strips((source.width_px, source.height_px), border_px)
        transform = source.georeference.transform
        if source.georeference.crs != crs or transform.b or transform.d:
            strips = [piece for strip in strips for piece in pieces_of(strip, border_px)]
        self._add_regions(plane, crs, number, BORDER, strips)

    def _add_regions(
        self,
        plane: str,
        crs: CRS | None,
        number: int,
        name: str,
        boxes: Iterable[tuple[float, float, float, float]],
    ) -> None:
        labels = [
            Label(name, ((x0, y0), (x1, y0), (x1, y1), (x0, y1)), True) for x0, y0, x1, y1 in boxes
        ]
        self._add(plane, (_Placed(self._to_plane(label, number, crs), number) for label in labels))

    def _add(self, plane: str, placed: Iterable[_Placed]) -> None:
        reach = self._settings.point_box_m / 2
        left, bottom, right, top = self._extents[plane]
        for item in placed:
            xs, ys = zip(*item.label.corners, strict=True)
            if not all(map(math.isfinite, (*xs, *ys))):
                continue
            # A label may reach around the world; nobody asks beyond the cells.
            for column in _bins(max(min(xs) - reach, left), min(max(xs) + reach, right)):
                for row in _bins(max(min(ys) - reach, bottom), min(max(ys) + reach, top)):
                    self._bins[plane, column, row].append(item)

    def on(self, cell: Cell, owner: Int[NDArray[np.int32], "S S"]) -> list[Annotation]:
        """Returns vehicles and ignore regions of a tile.

        Args:
            owner: the number of the source of each of its pixels, -1 where empty.
        """
        plane = plane_of(cell.crs, cell.sources)
        left, bottom, right, top = cell.extent
        near: dict[int, _Placed] = {}
        for column in _bins(left, right):
            for row in _bins(bottom, top):
                near |= {id(item): item for item in self._bins.get((plane, column, row), ())}
        inverse = ~cell.transform
        annotations = []
        for item in near.values():
            label = dataclasses.replace(
                item.label, corners=tuple(inverse * corner for corner in item.label.corners)
            )
            annotations += self._annotate(label, item, cell, owner)
        return annotations

    def _annotate(
        self, label: Label, item: _Placed, cell: Cell, owner: Int[NDArray[np.int32], "S S"]
    ) -> list[Annotation]:
        source = item.source
        size = cell.size_px
        x, y = _middle(label)
        inside = 0 <= x < size and 0 <= y < size
        unlabelled = label.class_name in (EVERYTHING, BORDER)
        if unlabelled:
            if not (owner == source).any():
                return []
        else:
            shown = int(owner[min(max(int(y), 0), size - 1), min(max(int(x), 0), size - 1)])
            if source is not None and shown not in (source, -1):
                return []
            if not inside or shown < 0 or self._in_border(cell.transform * (x, y), cell.crs, shown):
                label = dataclasses.replace(label, ignore=True)
        truths, ignored = sort_labels(
            [label],
            classes=self._classes,
            size_px=(size, size),
            border_px=0.0,
            point_box_px=self._settings.point_box_m / cell.gsd_m,
        )
        annotations = []
        for box, ignore in [
            *((b, False) for b in truths.tolist()),
            *((b, True) for b in ignored.tolist()),
        ]:
            fraction = 1.0
            if not ignore:
                fraction = (
                    (box[2] - box[0])
                    * (box[3] - box[1])
                    / max(_area(label, self._settings, cell), 1e-9)
                )
            centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2) if ignore else (x, y)
            corners = None
            if item.oriented and not ignore and _near(label.corners):
                corners = corners_lengthwise(label)
            annotations.append(
                Annotation(
                    (box[0], box[1], box[2], box[3]),
                    centre,
                    min(fraction, 1.0),
                    ignore=ignore,
                    corners_px=corners,
                    unlabelled=unlabelled,
                )
            )
        return annotations

    def _in_border(self, place: Point, crs: CRS | None, number: int) -> bool:
        border, source = self._settings.border_px, self._sources[number]
        if not border:
            return False
        x, y = (
            ~source.georeference.transform
            * to_reference_system(crs, source.georeference.crs, [place])[0]
        )
        return not (
            border <= x <= source.width_px - border and border <= y <= source.height_px - border
        )


def _near(corners: Iterable[Point]) -> bool:
    """Tells corners of a vehicle from numbers that nothing could be drawn with."""
    return all(abs(value) <= FARTHEST_PX for corner in corners for value in corner)


def _bins(low_m: float, high_m: float) -> range:
    """Numbers the bins from one place to another; none where the second comes first."""
    return range(math.floor(low_m / BIN_M), math.floor(high_m / BIN_M) + 1)


def _vehicle_classes(labels: Labels, settings: LabelSettings) -> tuple[str, ...]:
    if settings.classes:
        require_classes(labels, settings.classes, str(settings.path))
        return settings.classes
    if len(labels.classes) > 1:
        raise ImageryError(
            f"{settings.path} names the classes {', '.join(labels.classes)}; say with "
            "--labels.classes (--label-classes of skyproof assess) which of them count as vehicles "
            "(small vehicles in the paper)."
        )
    return labels.classes


def _middle(label: Label) -> Point:
    xs, ys = zip(*label.corners, strict=True)
    return (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2


def _area(label: Label, settings: LabelSettings, cell: Cell) -> float:
    if len(label.corners) == 1:
        return float((settings.point_box_m / cell.gsd_m) ** 2)
    xs, ys = zip(*label.corners, strict=True)
    return float((max(xs) - min(xs)) * (max(ys) - min(ys)))


def _inside_picture(place: Point, size_px: tuple[int, int]) -> bool:
    return 0 <= place[0] <= size_px[0] and 0 <= place[1] <= size_px[1]


def _within(places: NDArray[np.float64], extent: Extent) -> NDArray[np.bool_]:
    left, bottom, right, top = extent
    x, y = places[:, 0], places[:, 1]
    return (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
