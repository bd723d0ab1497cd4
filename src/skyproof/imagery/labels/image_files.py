"""Collects labels in pixels of images, for every form; finds the images, reads the lines."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from rasterio.errors import RasterioError

from skyproof.errors import ImageryError
from skyproof.files import refuse_special
from skyproof.imagery.labels.label import (
    ImageLabels,
    Label,
    cut_to_image,
    flat_note,
    refuse_mostly_beyond,
    twice_note,
)
from skyproof.imagery.rasters import RASTER_SUFFIXES, open_raster, orientation_of, upright_size_px
from skyproof.words import counted

LARGEST_NUMBER = 1e9
"""No label lies farther away, in pixels, metres or degrees."""
IMAGE_FOLDERS = ("images", "JPEGImages")
LABEL_FOLDERS = ("labelTxt", "labels", "annotations", "Annotations")
"""Names in place of those of images: by DOTA, Ultralytics, VisDrone and Pascal VOC."""
_LARGEST_BYTES = 256 * 2**20


class LabelledImages:
    """Collects labels by image, refuses damaged ones, and leaves out boxes without size.

    `box_form` describes the numbers of a box in this form of labels.
    """

    def __init__(self, path: Path, box_form: str) -> None:
        self.path = path
        self.box_form = box_form
        # Labels as keys keep their order, and none stands there twice.
        self.labels: dict[str, dict[Label, None]] = {}
        self._added = self._twice = self._cut = self._placed = 0
        self._flat: list[str] = []
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
        self._added += 1
        left, top, right, bottom = label.bounds
        if left >= right or top >= bottom:
            self._flat.append(where)
            return
        if name in self.sizes_px:
            whole, label = label, cut_to_image(label, self.sizes_px[name], where)
            self._placed += 1
            self._cut += label != whole
        self._twice += label in self.labels[name]
        self.labels[name][label] = None

    @property
    def classes_found(self) -> list[str]:
        return sorted({label.class_name for labels in self.labels.values() for label in labels})

    def with_classes(self, classes: Iterable[str], *notes: str) -> ImageLabels:
        images = {name: tuple(labels) for name, labels in self.labels.items()}
        notes += twice_note(self._twice, self.path)
        notes += flat_note(self._flat, self._added, self.path, self.box_form)
        refuse_mostly_beyond(self._cut, self._placed, self.path, self.box_form)
        if self._cut:
            cut = counted(self._cut, "box", "boxes")
            notes += (f"cut {cut} of {self.path} at the edge of the image",)
        return ImageLabels(tuple(classes), images, self.sizes_px, notes, self.box_form)


def damaged(where: str, what: str) -> ImageryError:
    return ImageryError(f"{where} {what}; correct it.")


def read_text(path: Path) -> str:
    refuse_special(path, "split the labels", error=ImageryError, largest_bytes=_LARGEST_BYTES)
    try:
        # Editors on Windows may begin a text with a byte order mark.
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ImageryError(
            f"{path} is not text that can be read ({reason}); give label text in UTF-8."
        ) from error


def label_texts(folder: Path, ending: str = ".txt") -> list[Path]:
    """Returns the texts in a folder; below it, too, if it is called like a folder of labels."""
    search = folder.rglob if folder.name in LABEL_FOLDERS else folder.glob
    return sorted(search(f"*{ending}"))


def text_lines(path: Path) -> list[tuple[str, list[str]]]:
    """Returns file and number of every line that is not blank, for messages, and its words."""
    lines = enumerate(read_text(path).splitlines(), 1)
    return [(f"{path} line {number}", line.split()) for number, line in lines if line.strip()]


def label_numbers(words: Sequence[str]) -> list[float]:
    """Returns words as numbers; nothing if one is no number, not finite, or beyond the largest."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return []
    # NaN is not below it either.
    return values if all(abs(value) <= LARGEST_NUMBER for value in values) else []


def image_of(text: Path) -> Path | None:
    """Finds the image of the same stem, beside it or in a folder of images instead of labels."""
    folders, parts = [text.parent], text.parent.parts
    last = max((at for at, part in enumerate(parts) if part in LABEL_FOLDERS), default=None)
    if last is not None:
        folders += [Path(*parts[:last], name, *parts[last + 1 :]) for name in IMAGE_FOLDERS]
    endings = [spelt for suffix in RASTER_SUFFIXES for spelt in (suffix, suffix.upper())]
    candidates = (folder / f"{text.stem}{ending}" for folder in folders for ending in endings)
    return next((image for image in candidates if image.is_file()), None)


def image_size_px(path: Path) -> tuple[int, int]:
    try:
        with open_raster(path) as dataset:
            return upright_size_px(dataset, orientation_of(dataset, path))
    except (RasterioError, OSError, ValueError) as error:
        raise ImageryError(
            f"{path} cannot be read as an image; replace it, or leave it out."
        ) from error
