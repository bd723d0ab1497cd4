"""Reads labels of any of the known forms: COCO, YOLO text, DOTA oriented boxes, vector files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.imagery.labels.coco import read_coco_labels
from skyproof.imagery.labels.ground import crs_name, read_ground_labels
from skyproof.imagery.labels.image_files import (
    IMAGE_FOLDER,
    LABEL_FOLDERS,
    text_lines,
)
from skyproof.imagery.labels.label import Labels
from skyproof.imagery.labels.texts import is_dota_line, read_dota_labels
from skyproof.imagery.labels.yolo import class_file, read_yolo_labels

_FORMS = (
    "COCO (.json), GeoJSON (.geojson or .json), GeoPackage (.gpkg), Shapefile (.shp), a folder of "
    "YOLO text with a .names file or data.yaml, or a folder of DOTA text"
)


class _LabelForm(msgspec.Struct):
    type: Any = None
    crs: Any = None
    images: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    annotations: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


def read_labels(path: Path, classes: Sequence[str] = ()) -> Labels:
    """Reads labels of any known form.

    The wanted `classes` tell which field of a vector file names classes, also as FIELD=CLASS.

    A folder is YOLO text if it holds `data.yaml` or one `.names` file, COCO if it holds
    `annotations.json` (as our own datasets do), and DOTA text by its `.txt` files, or those in
    `labelTxt/`.

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


def _read_folder(folder: Path) -> Labels:
    # A user who names one of two folders beside each other means both.
    halves = (IMAGE_FOLDER, *LABEL_FOLDERS)
    if folder.name in halves and class_file(folder) is None and class_file(folder.parent):
        folder = folder.parent
    names = class_file(folder)
    if names is not None:
        return read_yolo_labels(folder, names)
    if (folder / "annotations.json").is_file():
        return read_labels(folder / "annotations.json")
    place = folder / LABEL_FOLDERS[1] if (folder / LABEL_FOLDERS[1]).is_dir() else folder
    texts = sorted(place.glob("*.txt"))
    if not texts:
        raise ImageryError(f"{folder} holds no labels; expected {_FORMS}.")
    # Files may be empty (an image without vehicles): the first line in any of them decides.
    lines = ((text, words) for text in texts for _, words in text_lines(text))
    text, words = next(lines, (folder, []))
    if not words or not is_dota_line(words):
        line = f"{text} begins {' '.join(words[:6])!r}" if words else "all its .txt files are empty"
        raise ImageryError(
            f"{folder} is neither DOTA text ({line}) nor YOLO text (0 .names files and no "
            "data.yaml); add the class names for YOLO, or give other labels."
        )
    return read_dota_labels(place)
