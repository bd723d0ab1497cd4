"""Writes a dataset's labels for other tools: COCO, YOLO text, DOTA text, GeoJSON points."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from rasterio.crs import CRS

from skyproof.datasets.annotations import (
    ANNOTATIONS,
    REMEDY,
    AnnotationFile,
    AnnotationRow,
    CategoryRow,
    read_annotations,
)
from skyproof.errors import ImageryError, StoredFileError
from skyproof.files import finished_folder, new_file, refuse_existing, write_json
from skyproof.imagery.labels.label import Point
from skyproof.imagery.labels.text import LABEL_FOLDERS
from skyproof.imagery.tiles.georeference import to_reference_system
from skyproof.imagery.tiles.grid import Extent
from skyproof.imagery.tiles.tile_index import GROUND_INDEX, read_places
from skyproof.ranges import Coordinate, ImageSide, Seed


class _Outline(msgspec.Struct):
    """Uncompressed COCO run lengths, as the renderer writes them."""

    size: tuple[ImageSide, ImageSide]
    counts: list[Annotated[int, Meta(ge=0, le=2**28)]]


class _Row(AnnotationRow, kw_only=True, frozen=True):
    """An annotation with what other tools want to know of it."""

    category_id: Seed
    centre_px: tuple[Coordinate, Coordinate] | None = None
    corners_px: tuple[tuple[Coordinate, Coordinate], ...] | None = None
    area: Annotated[float, Meta(ge=0, le=1e18)] | None = None
    segmentation: _Outline | None = None


class _File(AnnotationFile, kw_only=True, frozen=True):
    """The whole file, outlines and all."""

    categories: tuple[CategoryRow, ...]
    annotations: tuple[_Row, ...]


@dataclass(frozen=True)
class _Object:
    """One annotation of a dataset: its box in xywh, and the corners on the ground where known."""

    box: tuple[float, float, float, float]
    category: str
    ignore: bool
    corners: tuple[Point, ...] | None
    row: _Row

    @property
    def upright(self) -> tuple[Point, ...]:
        left, top, width, height = self.box
        return (left, top), (left + width, top), (left + width, top + height), (left, top + height)

    @property
    def centre(self) -> Point:
        return self.box[0] + self.box[2] / 2, self.box[1] + self.box[3] / 2

    @property
    def middle(self) -> Point:
        """The vehicle's own middle: where the border cuts it, that of its box is another."""
        return self.row.centre_px or self.centre


@dataclass(frozen=True)
class _Image:
    """One image of a dataset."""

    name: str
    file: Path
    width: int
    height: int
    objects: tuple[_Object, ...]


@dataclass(frozen=True)
class _Dataset:
    folder: Path
    categories: tuple[str, ...]
    images: tuple[_Image, ...]
    gsd_m: float


@dataclass(frozen=True)
class Exported:
    """What an export holds.

    Attributes:
        images, vehicles, ignored: as written.
        left_out: ignore regions that the form cannot say.
        upright: vehicles whose heading is not known, so that their oriented box is the upright one.
    """

    images: int
    vehicles: int
    ignored: int
    left_out: int = 0
    upright: int = 0


Progress = Callable[[int, int], None]


def export_labels(
    dataset: Path, form: str, out: Path, *, progress: Progress | None = None
) -> Exported:
    """Writes a dataset's labels in another form, whole or not at all.

    - "coco": one JSON file of plain instances; file names are relative to the dataset.
    - "yolo": a folder with `images/`, `labels/` and `data.yaml`, as Ultralytics trains from; ignore
      regions cannot be said and are left out.
    - "dota": a folder with `images/` and `labelTxt/`; a vehicle's corners are those of the ground
      it stands on where the renderer knew them and their middle is in the image, else of its
      upright box. Ignore regions are `difficult`.
    - "geojson": points of vehicles, outlines of ignore regions (property `ignore`), WGS 84; only
      for a split of a folder that `skyproof ground` wrote from georeferenced imagery.

    Args:
        dataset: folder with `annotations.json` of ours.
        form: one of `LABEL_FORMS`.
        out: file or folder to write.
        progress: called with (images done, images in all).

    Raises:
        StoredFileError: the dataset is missing or damaged.
        ImageryError: another form, no images, or images without a place on the map.
        RunFolderError: `out` exists, or the disk cannot take it.
    """
    if form not in LABEL_FORMS:
        raise ImageryError(
            f"There is no label form {form!r}; choose one of {', '.join(LABEL_FORMS)}."
        )
    refuse_existing(Path(out))
    return LABEL_FORMS[form](
        _read(Path(dataset)), Path(out), progress or (lambda done, total: None)
    )


def _read(folder: Path) -> _Dataset:
    document, files = read_annotations(folder, _File)
    path = folder / ANNOTATIONS
    if not document.images:
        raise ImageryError(f"{folder} holds no images; give another dataset.")
    categories = {row.id: row.name for row in document.categories}
    objects: dict[int, list[_Object]] = {row.id: [] for row in document.images}
    for number, row in enumerate(document.annotations):
        if row.category_id not in categories:
            raise StoredFileError(
                f"{path}, annotations[{number}] has the category {row.category_id}, which is not "
                f"listed; {REMEDY}."
            )
        item = _Object(
            row.bbox, categories[row.category_id], bool(row.iscrowd), row.corners_px or None, row
        )
        if row.bbox[2] > 0 and row.bbox[3] > 0:
            objects[row.image_id].append(item)
    stems: set[str] = set()
    for file in files:
        # Text forms have one file an image, called by its stem.
        if file.stem in stems:
            raise StoredFileError(f"{path} has two images called {file.stem}; {REMEDY}.")
        stems.add(file.stem)
    images = tuple(
        _Image(row.scene_id, file, row.width, row.height, tuple(objects[row.id]))
        for row, file in zip(document.images, files, strict=True)
    )
    return _Dataset(folder, tuple(categories.values()), images, document.info.gsd_m)


def _count(data: _Dataset, **more: int) -> Exported:
    objects = [item for image in data.images for item in image.objects]
    ignored = sum(item.ignore for item in objects)
    return Exported(
        len(data.images), len(objects) - ignored, ignored - more.get("left_out", 0), **more
    )


def _write_coco(data: _Dataset, out: Path, progress: Progress) -> Exported:
    numbers = {name: index for index, name in enumerate(data.categories, 1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, image in enumerate(data.images, 1):
        file = image.file.relative_to(data.folder).as_posix()
        images.append(
            {"id": number, "file_name": file, "width": image.width, "height": image.height}
        )
        for item in image.objects:
            row: dict[str, Any] = {
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": numbers[item.category],
            }
            row |= {"bbox": list(item.box), "iscrowd": int(item.ignore)}
            more = {"area": item.row.area, "segmentation": item.row.segmentation}
            known = {key: value for key, value in more.items() if value is not None}
            annotations.append(row | msgspec.to_builtins(known))
        progress(number, len(data.images))
    categories = [{"id": number, "name": name} for name, number in numbers.items()]
    info = {"description": "skyproof dataset", "gsd_m": data.gsd_m}
    document = {
        "info": info,
        "licenses": [],
        "categories": categories,
        "images": images,
        "annotations": annotations,
    }
    with new_file(out):
        write_json(out, document)
    return _count(data)


def _write_yolo(data: _Dataset, out: Path, progress: Progress) -> Exported:
    numbers = {name: index for index, name in enumerate(data.categories)}

    def lines(image: _Image) -> list[str]:
        rows = []
        for item in image.objects:
            if not item.ignore:
                x, y = item.centre
                parts = (
                    x / image.width,
                    y / image.height,
                    item.box[2] / image.width,
                    item.box[3] / image.height,
                )
                rows.append(
                    f"{numbers[item.category]} " + " ".join(f"{part:.7f}" for part in parts)
                )
        return rows

    with finished_folder(out) as partial:
        _write_texts(data, partial, "labels", lines, progress)
        names = "".join(f"  {number}: {_quoted(name)}\n" for name, number in numbers.items())
        # Ultralytics asks for both splits; one dataset of ours is one.
        remark = "# To validate on another export, name its images folder."
        text = f"{remark}\ntrain: images\nval: images\nnames:\n"
        (partial / "data.yaml").write_text(text + names, encoding="utf-8")
    return _count(
        data, left_out=sum(item.ignore for image in data.images for item in image.objects)
    )


def _quoted(name: str) -> str:
    """Gives a name as YAML; quoted where a sign in it could mean something else."""
    return name if re.fullmatch(r"[A-Za-z][A-Za-z0-9_ -]*", name) else json.dumps(name)


def _write_dota(data: _Dataset, out: Path, progress: Progress) -> Exported:
    upright = 0

    def lines(image: _Image) -> list[str]:
        nonlocal upright
        rows = []
        for item in image.objects:
            corners = item.upright
            if item.corners and not item.ignore and _middle_inside(item.corners, image):
                corners = item.corners
            elif not item.ignore:
                upright += 1
            numbers = " ".join(f"{value:.2f}" for corner in corners for value in corner)
            rows.append(f"{numbers} {'-'.join(item.category.split())} {int(item.ignore)}")
        return rows

    with finished_folder(out) as partial:
        _write_texts(data, partial, LABEL_FOLDERS[1], lines, progress)
    return _count(data, upright=upright)


def _middle_inside(corners: tuple[Point, ...], image: _Image) -> bool:
    x, y = (sum(values) / len(corners) for values in zip(*corners, strict=True))
    return 0 <= x <= image.width and 0 <= y <= image.height


def _write_texts(
    data: _Dataset,
    partial: Path,
    folder: str,
    lines: Callable[[_Image], list[str]],
    progress: Progress,
) -> None:
    """Writes one text per image and a copy of the image beside, in `images/`."""
    for place in (partial / folder, partial / "images"):
        place.mkdir()
    for number, image in enumerate(data.images, 1):
        text = "".join(f"{line}\n" for line in lines(image))
        (partial / folder / f"{image.file.stem}.txt").write_text(text, encoding="utf-8")
        if not image.file.is_file():
            raise StoredFileError(f"{image.file} is missing; {REMEDY}.")
        shutil.copyfile(image.file, partial / "images" / image.file.name)
        progress(number, len(data.images))


def _write_geojson(data: _Dataset, out: Path, progress: Progress) -> Exported:
    tiles = _tiles(data)
    features = []
    for number, image in enumerate(data.images, 1):
        crs, (left, bottom, right, top) = tiles[image.name]
        step_x, step_y = (right - left) / image.width, (top - bottom) / image.height
        for item in image.objects:
            # Rings of a polygon end where they began, and run anticlockwise with north up.
            pixels = [*reversed(item.upright), item.upright[-1]] if item.ignore else [item.middle]
            ground = [(left + x * step_x, top - y * step_y) for x, y in pixels]
            degrees = to_reference_system(crs, CRS.from_epsg(4326), ground)
            places = [[round(x, 9), round(y, 9)] for x, y in degrees]
            geometry: dict[str, Any] = {"type": "Polygon", "coordinates": [places]}
            if not item.ignore:
                geometry = {"type": "Point", "coordinates": places[0]}
            properties = {"class": item.category, "ignore": item.ignore, "tile": image.name}
            features.append({"type": "Feature", "properties": properties, "geometry": geometry})
        progress(number, len(data.images))
    with new_file(out):
        write_json(out, {"type": "FeatureCollection", "features": features})
    return _count(data)


def _tiles(data: _Dataset) -> dict[str, tuple[CRS, Extent]]:
    """Reads per image the reference system and the (left, bottom, right, top) of its tile."""
    path = data.folder.resolve().parent / GROUND_INDEX
    if not path.is_file():
        raise ImageryError(
            f"{data.folder} has no place on the map ({path} is missing); GeoJSON needs a split of "
            "georeferenced tiles, as `skyproof ground` cuts them."
        )
    tiles = read_places(path.parent)
    missing = next((image.name for image in data.images if image.name not in tiles), None)
    if missing is not None:
        raise ImageryError(
            f"{data.folder} holds {missing}, which {path} does not place on the map; leave out "
            "imagery without georeference when tiling, or choose another form."
        )
    return tiles


LABEL_FORMS: Mapping[str, Callable[[_Dataset, Path, Progress], Exported]] = {
    "coco": _write_coco,
    "yolo": _write_yolo,
    "dota": _write_dota,
    "geojson": _write_geojson,
}
