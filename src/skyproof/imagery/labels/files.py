"""Reads labels of any of the known forms, each in a file beside this one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.imagery.labels.coco import read_coco_labels
from skyproof.imagery.labels.ground import crs_name, read_ground_labels
from skyproof.imagery.labels.image_files import (
    IMAGE_FOLDERS,
    LABEL_FOLDERS,
    label_texts,
    text_lines,
)
from skyproof.imagery.labels.label import Labels
from skyproof.imagery.labels.texts import (
    is_dota_line,
    is_visdrone_line,
    read_dota_labels,
    read_visdrone_labels,
)
from skyproof.imagery.labels.voc import read_voc_labels, voc_files
from skyproof.imagery.labels.yolo import class_file, is_yolo_line, read_yolo_labels, split_texts

_FORMS = (
    "COCO (.json), GeoJSON (.geojson or .json), GeoPackage (.gpkg), Shapefile (.shp), or a folder "
    "of YOLO text with its images, DOTA text, VisDrone text or Pascal VOC .xml"
)

_SUFFIXES = (".txt", ".xml", ".yaml", ".names", ".json", ".geojson")


class _LabelForm(msgspec.Struct):
    type: Any = None
    crs: Any = None
    images: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    annotations: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


def read_labels(path: Path, classes: Sequence[str] = ()) -> Labels:
    """Reads labels of any known form.

    The wanted `classes` tell which field of a vector file names classes, also as FIELD=CLASS.

    A folder is YOLO text if it holds `data.yaml`, one `.names` file or `classes.txt`, and COCO if
    it holds `annotations.json` (as our own datasets do). Otherwise the first line of its `.txt`
    files decides, or its `.xml` files do, there or in one of `LABEL_FOLDERS`.

    Raises:
        ImageryError: the path is missing, empty, damaged or of another form.
    """
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        raise ImageryError(f"{path} is missing; give labels as {_FORMS}.")
    if path.suffix.lower() in (".gpkg", ".shp"):
        return read_ground_labels(path, classes)
    if path.suffix.lower() not in (".json", ".geojson"):
        raise ImageryError(f"{path} is not of a known label form; expected {_FORMS}.")
    kind: _LabelForm = read_document(path, _LabelForm, "replace the file", error=ImageryError)
    if kind.type == "FeatureCollection":
        return read_ground_labels(path, classes, crs_name(path, kind.crs))
    if kind.images is not msgspec.UNSET and kind.annotations is not msgspec.UNSET:
        return read_coco_labels(path)
    raise ImageryError(
        f"{path} is JSON but neither COCO nor a GeoJSON FeatureCollection; expected {_FORMS}."
    )


def label_files(folder: Path) -> list[Path]:
    """Lists the files of a folder on which its labels depend, without the images."""
    roots = _roots(folder)
    below = (file for root in roots for name in LABEL_FOLDERS for file in (root / name).rglob("*"))
    every = (*folder.iterdir(), *below, *split_texts(folder))
    found = {file for file in every if file.suffix.lower() in _SUFFIXES}
    return sorted(found | {names for names in map(class_file, roots) if names is not None})


def _roots(folder: Path) -> list[Path]:
    """Returns a folder, and its parent if it is one of a pair: users who name one mean both."""
    halved = folder.name in (*IMAGE_FOLDERS, *LABEL_FOLDERS)
    return [folder, folder.parent] if halved else [folder]


def _read_folder(folder: Path) -> Labels:
    roots = _roots(folder)
    for root in roots:
        names = class_file(root)
        if names is not None:
            return read_yolo_labels(root, names)
    if (folder / "annotations.json").is_file():
        return read_labels(folder / "annotations.json")
    strange = ""
    for place in (*(root / name for root in roots for name in LABEL_FOLDERS), folder):
        # Files may be empty (an image without vehicles): the first line in any of them decides.
        texts = label_texts(place)
        lines = ((text, words) for text in texts for _, words in text_lines(text))
        text, words = next(lines, (place, []))
        if words and is_dota_line(words):
            return read_dota_labels(place)
        if words and is_visdrone_line(words):
            return read_visdrone_labels(place)
        if words and is_yolo_line(words):
            return read_yolo_labels(place, None)
        annotations = [*voc_files(place)]
        if annotations:
            return read_voc_labels(place, annotations)
        if texts:
            strange = f"{text} begins {' '.join(words[:6])[:100]!r}" if words else "all are empty"
    if strange:
        raise ImageryError(
            f"{folder} holds .txt files, but not of DOTA, VisDrone or YOLO ({strange}); expected "
            f"{_FORMS}."
        )
    raise ImageryError(f"{folder} holds no labels; expected {_FORMS}.")
