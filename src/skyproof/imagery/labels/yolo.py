"""Reads labels as YOLO text, and the names of its classes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from skyproof.errors import ImageryError
from skyproof.imagery.labels.image_files import (
    LABEL_FOLDERS,
    LabelledImages,
    damaged,
    finite_numbers,
    image_of,
    image_size_px,
    read_text,
    text_lines,
    upright_label,
)
from skyproof.imagery.labels.label import ImageLabels, Label


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
    images = LabelledImages(folder)
    root = folder / LABEL_FOLDERS[0]
    for text in sorted(root.rglob("*.txt") if root.is_dir() else folder.glob("*.txt")):
        image = image_of(text)
        if image is None:
            continue
        size_px = image_size_px(image)
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
        index, *values = finite_numbers(words)
        if len(values) not in (4, 8):
            raise ValueError
    except ValueError as error:
        raise damaged(where, "is not 'class cx cy w h' or 'class x1 y1 ... x4 y4'") from error
    if index != int(index) or not 0 <= index < len(classes):
        raise damaged(where, f"has class {index:g} but there are {len(classes)} names")
    if len(values) == 4:
        x, y, width, height = values
        box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        shares = upright_label("", box, where).corners
    else:
        shares = tuple(zip(values[::2], values[1::2], strict=True))
    return Label(classes[int(index)], tuple((x * size_px[0], y * size_px[1]) for x, y in shares))


def _classes(path: Path) -> list[str]:
    text = read_text(path)
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
