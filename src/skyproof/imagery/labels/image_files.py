"""Reads labels in pixels of images: COCO, YOLO text and DOTA text."""

import math
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any

import msgspec
import yaml
from msgspec import Meta
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from skyproof.documents import read_document
from skyproof.errors import ImageryError
from skyproof.files import refuse_special
from skyproof.imagery.labels.label import Box, ImageLabels, Label, cut_to_image, twice_note
from skyproof.imagery.rasters import RASTER_SUFFIXES, open_raster
from skyproof.ranges import Coordinate

LARGEST_NUMBER = 1e9
"""No label lies farther away, in pixels, metres or degrees."""
IMAGE_FOLDER = "images"
LABEL_FOLDERS = ("labels", "labelTxt")
"""Names that replace `images` in the path of an image, by Ultralytics and DOTA."""
_LARGEST_BYTES = 256 * 2**20
_DOTA_HEADERS = ("imagesource:", "gsd:")

# Tools count, also in floats, or name every row.
_Id = (
    Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
    | Annotated[float, Meta(ge=-(2**63), le=2**63)]
    | Annotated[str, Meta(max_length=200)]
)
_ImageSize = Annotated[float, Meta(ge=0, le=1e6)]


class _CocoCategory(msgspec.Struct):
    id: _Id
    name: Annotated[str, Meta(max_length=200)]


class _CocoImage(msgspec.Struct):
    id: _Id
    file_name: Annotated[str, Meta(max_length=4000)]
    width: _ImageSize | None = None
    height: _ImageSize | None = None


class _CocoAnnotation(msgspec.Struct):
    image_id: _Id
    category_id: _Id
    bbox: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    id: _Id | None = None
    iscrowd: bool | Annotated[float, Meta(ge=0, le=1)] = 0


class _CocoFile(msgspec.Struct):
    categories: list[_CocoCategory]
    images: list[_CocoImage]
    annotations: list[_CocoAnnotation]


class _LabelledImages:
    """Collects labels by image, and refuses damaged ones."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # Labels as keys keep their order, and none stands there twice.
        self.labels: dict[str, dict[Label, None]] = {}
        self._twice = self._cut = 0
        self.sizes_px: dict[str, tuple[int, int]] = {}

    def add_image(self, name: str, size_px: tuple[int, int] | None) -> None:
        if name in self.labels:
            raise ImageryError(
                f"{self.path} labels two images called {name!r}; rename one of them, or split the "
                "labels."
            )
        self.labels[name] = {}
        if size_px is not None:
            self.sizes_px[name] = size_px

    def add(self, name: str, label: Label, where: str) -> None:
        left, top, right, bottom = label.bounds
        if left >= right or top >= bottom:
            raise _damaged(where, "has a box without size")
        if name in self.sizes_px:
            whole, label = label, cut_to_image(label, self.sizes_px[name], where)
            self._cut += label != whole
        self._twice += label in self.labels[name]
        self.labels[name][label] = None

    def with_classes(self, classes: Iterable[str]) -> ImageLabels:
        images = {name: tuple(labels) for name, labels in self.labels.items()}
        notes = twice_note(self._twice, self.path)
        if self._cut:
            notes += (f"{self._cut} boxes of {self.path} are cut at the edge of their image",)
        return ImageLabels(tuple(classes), images, self.sizes_px, notes)


def _damaged(where: str, what: str) -> ImageryError:
    return ImageryError(f"{where} {what}; correct it.")


def _upright(class_name: str, box: Box, where: str, ignore: bool = False) -> Label:
    left, top, right, bottom = box
    if not (left < right and top < bottom):
        raise _damaged(where, "has a box without size")
    return Label.upright(class_name, box, ignore)


def read_coco_labels(path: Path) -> ImageLabels:
    """Reads categories, images and boxes of a COCO file; crowds become ignore regions."""
    document: _CocoFile = read_document(path, _CocoFile, "correct it", error=ImageryError)
    categories = {row.id: row.name for row in document.categories}
    images = _LabelledImages(path)
    names: dict[float | str, str] = {}
    for image in document.images:
        # Only the name of a path counts: no file is opened by it.
        names[image.id] = PureWindowsPath(image.file_name).stem
        size_px = int(image.width or 0), int(image.height or 0)
        images.add_image(names[image.id], size_px if image.width and image.height else None)
    if not names:
        raise ImageryError(f"{path} lists no images; give another file.")
    for number, row in enumerate(document.annotations, 1):
        where = f"{path} annotation {number if row.id is None else row.id}"
        if row.image_id not in names:
            raise _damaged(where, f"belongs to image {row.image_id}, which is not listed")
        if row.category_id not in categories:
            known = ", ".join(f"{key} ({name})" for key, name in categories.items()) or "none"
            what = f"has category {row.category_id} but the file lists {known[:500]}"
            raise _damaged(where, what)
        left, top, width, height = row.bbox
        box = (left, top, left + width, top + height)
        label = _upright(categories[row.category_id], box, where, bool(row.iscrowd))
        images.add(names[row.image_id], label, where)
    return images.with_classes(dict.fromkeys(categories.values()))


def class_file(folder: Path) -> Path | None:
    """Finds the class names of a YOLO folder: `data.yaml`, its one `.names` file, or None."""
    names = sorted(folder.glob("*.names"))
    if (folder / "data.yaml").is_file():
        return folder / "data.yaml"
    if len(names) > 1:
        raise ImageryError(
            f"{folder} holds {len(names)} .names files but exactly one must list its classes; keep "
            "one."
        )
    return names[0] if names else None


def read_yolo_labels(folder: Path, names: Path) -> ImageLabels:
    """Reads `class cx cy w h` or `class x1 y1 ... x4 y4` lines, as shares of the image's sides.

    Texts without an image of their name, such as a read-me, are skipped.
    """
    classes = _classes(names)
    images = _LabelledImages(folder)
    root = folder / LABEL_FOLDERS[0]
    for text in sorted(root.rglob("*.txt") if root.is_dir() else folder.glob("*.txt")):
        image = _image_of(text)
        if image is None:
            continue
        size_px = _image_size_px(image)
        images.add_image(image.stem, size_px)
        for where, words in text_lines(text):
            images.add(image.stem, _yolo_label(where, words, classes, size_px), where)
    if not images.labels:
        raise ImageryError(
            f"{folder} holds no label text (.txt) with an image of the same name; give another "
            "folder."
        )
    return images.with_classes(classes)


def _yolo_label(
    where: str, words: list[str], classes: Sequence[str], size_px: tuple[int, int]
) -> Label:
    try:
        index, *values = _finite_numbers(words)
        if len(values) not in (4, 8):
            raise ValueError
    except ValueError as error:
        raise _damaged(where, "is not 'class cx cy w h' or 'class x1 y1 ... x4 y4'") from error
    if index != int(index) or not 0 <= index < len(classes):
        raise _damaged(where, f"has class {index:g} but there are {len(classes)} names")
    if len(values) == 4:
        x, y, width, height = values
        box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        shares = _upright("", box, where).corners
    else:
        shares = tuple(zip(values[::2], values[1::2], strict=True))
    return Label(classes[int(index)], tuple((x * size_px[0], y * size_px[1]) for x, y in shares))


def _classes(path: Path) -> list[str]:
    text = _read_text(path)
    is_yaml = path.suffix == ".yaml"
    names = _yaml_names(text, path) if is_yaml else [line.strip() for line in text.splitlines()]
    while names and not names[-1]:
        names.pop()
    # An empty place counts, since labels name classes by their place.
    names = [name or f"class {place}" for place, name in enumerate(names)]
    if not names:
        raise ImageryError(
            f"{path} names no classes ('names:' as a list, or as numbers and names); add them."
        )
    return names


class _PlainLoader(yaml.BaseLoader):
    """Reads every value as text: a class may be called "no", and nothing is run.

    Aliases are refused, because a few aliases of aliases can stand for more than any memory holds.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuses aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has aliases, *name, which are not read")
        return super().compose_node(parent, index)


def _yaml_names(text: str, path: Path) -> list[str]:
    """Returns the values under `names:`: a list, or numbers from 0 with names; else nothing."""
    try:
        document = yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ImageryError(f"{path} is not YAML ({reason}); correct it.") from error
    names = document.get("names") if isinstance(document, dict) else None
    if isinstance(names, dict):
        names = [names.get(str(number)) for number in range(len(names))]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    return ["" if name in ("null", "~") else name for name in names]


def is_dota_line(words: list[str]) -> bool:
    """Tells whether a line is a DOTA header, or eight numbers and a class that is no number."""
    if words[0].lower().startswith(_DOTA_HEADERS):
        return True
    try:
        _finite_numbers(words[:8])
    except ValueError:
        return False
    return len(words) > 8 and not _is_number(words[8])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_dota_labels(folder: Path) -> ImageLabels:
    """Reads `x1 y1 ... x4 y4 class difficult` lines; difficult objects become ignore regions."""
    images = _LabelledImages(folder)
    for text in sorted(folder.glob("*.txt")):
        image = _image_of(text)
        images.add_image(text.stem, None if image is None else _image_size_px(image))
        for where, words in text_lines(text):
            if not words[0].lower().startswith(_DOTA_HEADERS):
                images.add(text.stem, _dota_label(where, words), where)
    return images.with_classes(
        sorted({label.class_name for labels in images.labels.values() for label in labels})
    )


def _dota_label(where: str, words: list[str]) -> Label:
    try:
        x1, y1, x2, y2, x3, y3, x4, y4 = _finite_numbers(words[:8])
        # Some writers leave out the difficulty.
        if len(words) not in (9, 10) or words[9:] not in ([], ["0"], ["1"], ["2"]):
            raise ValueError
    except ValueError as error:
        raise _damaged(where, "is not 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult'") from error
    corners = (x1, y1), (x2, y2), (x3, y3), (x4, y4)
    return Label(words[8], corners, ignore=words[9:] not in ([], ["0"]))


def _read_text(path: Path) -> str:
    refuse_special(path, "split the labels", error=ImageryError, largest_bytes=_LARGEST_BYTES)
    try:
        # Editors on Windows begin a text with a mark of its byte order.
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ImageryError(
            f"{path} is not text that can be read ({reason}); give label text in UTF-8."
        ) from error


def text_lines(path: Path) -> list[tuple[str, list[str]]]:
    """Returns file and number of every line that is not blank, for messages, and its words."""
    lines = enumerate(_read_text(path).splitlines(), 1)
    return [(f"{path} line {number}", line.split()) for number, line in lines if line.strip()]


def _finite_numbers(words: Sequence[str]) -> list[float]:
    values = [float(word) for word in words]
    if not all(math.isfinite(value) and abs(value) <= LARGEST_NUMBER for value in values):
        raise ValueError("not a number of a label")
    return values


def _image_of(text: Path) -> Path | None:
    """Finds the image of the same stem, beside the text or in `images` instead of `labels`."""
    folders, parts = [text.parent], text.parent.parts
    last = max((at for at, part in enumerate(parts) if part in LABEL_FOLDERS), default=None)
    if last is not None:
        folders.append(Path(*parts[:last], IMAGE_FOLDER, *parts[last + 1 :]))
    endings = [spelt for suffix in RASTER_SUFFIXES for spelt in (suffix, suffix.upper())]
    candidates = (folder / f"{text.stem}{ending}" for folder in folders for ending in endings)
    return next((image for image in candidates if image.is_file()), None)


def _image_size_px(path: Path) -> tuple[int, int]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with open_raster(path) as dataset:
                return int(dataset.width), int(dataset.height)
    except (RasterioError, OSError, ValueError) as error:
        raise ImageryError(
            f"{path} cannot be read as an image; replace it, or leave it out."
        ) from error
