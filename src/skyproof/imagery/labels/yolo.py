"""Reads YOLO text labels: one line an object, in parts of the image's width and height."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import ImageLabels, Label, require_inside
from skyproof.imagery.labels.text import (
    LABEL_FOLDERS,
    finite_numbers,
    image_of,
    image_size_px,
    name_once,
    read_text,
    text_lines,
)
from skyproof.imagery.tiles.georeference import image_name


def class_file(folder: Path) -> Path | None:
    """Finds the file that names a YOLO folder's classes: `data.yaml`, or its one `.names` file.

    None where there is neither.

    Raises:
        ImageryError: more than one `.names` file.
    """
    yaml = folder / "data.yaml"
    names = sorted(folder.glob("*.names"))
    if yaml.is_file():
        return yaml
    if len(names) > 1:
        raise ImageryError(
            f"{folder} holds {len(names)} .names files but exactly one must list its classes; keep "
            "one."
        )
    return names[0] if names else None


def read_yolo_labels(folder: Path) -> ImageLabels:
    """Reads `.txt` files beside their images, or in `labels/` beside `images/`.

    Lines are `class cx cy w h`, or `class x1 y1 x2 y2 x3 y3 x4 y4` for oriented boxes; the class
    counts from 0. The images' sizes come from their headers. A text without an image of its name (a
    read-me) is left out.

    Raises:
        ImageryError: no classes, no labels with an image, a damaged line, a class without a name,
            or a box outside its image; names the file and the line.
    """
    folder = Path(folder)
    source = class_file(folder)
    if source is None:
        raise ImageryError(
            f"{folder} holds 0 .names files and no data.yaml, but one must list its classes; add "
            "it."
        )
    classes = _classes(source)
    root = folder / LABEL_FOLDERS[0]
    texts = sorted(root.rglob("*.txt") if root.is_dir() else folder.glob("*.txt"))
    images: dict[str, tuple[Label, ...]] = {}
    sizes_px: dict[str, tuple[int, int]] = {}
    for text in texts:
        image = image_of(text)
        if image is None:
            continue
        name = image_name(image)
        name_once(name, images, folder)
        sizes_px[name] = image_size_px(image)
        images[name] = tuple(
            _label(f"{text} line {number}", words, classes, sizes_px[name])
            for number, words in text_lines(text)
        )
    if not images:
        raise ImageryError(
            f"{folder} holds no label text (.txt) with an image of the same name; give another "
            "folder."
        )
    return ImageLabels(classes, images, sizes_px)


def _label(
    where: str, words: list[str], classes: tuple[str, ...], size_px: tuple[int, int]
) -> Label:
    try:
        index, *values = finite_numbers(words)
        if len(values) not in (4, 8):
            raise ValueError
    except ValueError as error:
        raise ImageryError(
            f"{where} is not 'class cx cy w h' or 'class x1 y1 ... x4 y4'; correct it."
        ) from error
    if index != int(index) or not 0 <= index < len(classes):
        raise ImageryError(
            f"{where} has class {index:g} but there are {len(classes)} names; correct it."
        )
    if len(values) == 4:
        x, y, width, height = values
        if width <= 0 or height <= 0:
            raise ImageryError(f"{where} has a box without size; correct it.")
        left, top, right, bottom = x - width / 2, y - height / 2, x + width / 2, y + height / 2
        values = [left, top, right, top, right, bottom, left, bottom]
    corners = tuple(
        (x * size_px[0], y * size_px[1]) for x, y in zip(values[::2], values[1::2], strict=True)
    )
    label = Label(classes[int(index)], corners)
    require_inside(label, size_px, where)
    return label


def _classes(path: Path) -> tuple[str, ...]:
    text = read_text(path)
    names = (
        _yaml_names(text, path)
        if path.suffix == ".yaml"
        else [line.strip() for line in text.splitlines()]
    )
    names = [name for name in names if name]
    if not names:
        raise ImageryError(
            f"{path} names no classes ('names:' as a list, or as numbers and names); add them."
        )
    return tuple(names)


class _PlainLoader(yaml.BaseLoader):
    """Reads every value as text: a class may be called "no", and nothing is run.

    A few aliases of aliases can stand for more than any memory holds, so that none are read.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuses aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has aliases, *name, which are not read")
        return super().compose_node(parent, index)


def _yaml_names(text: str, path: Path) -> list[str]:
    """Returns what stands under `names:`: a list, or numbers from 0 with names; else nothing."""
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
    return names
