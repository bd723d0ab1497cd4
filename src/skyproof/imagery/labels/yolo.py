"""Reads labels as YOLO text, and the names of its classes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from skyproof.errors import ImageryError
from skyproof.imagery.labels.image_files import (
    IMAGE_FOLDERS,
    LabelledImages,
    damaged,
    image_of,
    image_size_px,
    label_numbers,
    label_texts,
    read_text,
    text_lines,
)
from skyproof.imagery.labels.label import ImageLabels, Label, outline_corners

_LABELS = "labels"


def class_file(folder: Path) -> Path | None:
    """Finds the class names of a YOLO folder: `data.yaml`, its one `.names` file, `classes.txt`."""
    names = sorted(folder.glob("*.names"))
    if (folder / "data.yaml").is_file():
        return folder / "data.yaml"
    if len(names) > 1:
        raise ImageryError(
            f"{folder} holds {len(names)} .names files but exactly one must list its classes; keep "
            "one."
        )
    names += [folder / "classes.txt", folder / _LABELS / "classes.txt"]
    return next((file for file in names if file.is_file()), None)


def is_yolo_line(words: list[str]) -> bool:
    """Returns whether a line is a class number and a box or polygon."""
    numbers = label_numbers(words)
    return _is_shape(numbers[1:]) and numbers[0] == int(numbers[0]) >= 0


def _is_shape(values: Sequence[float]) -> bool:
    return len(values) == 4 or (len(values) >= 6 and len(values) % 2 == 0)


def split_texts(folder: Path) -> list[Path]:
    """Returns the texts in folders called `labels` below a folder, such as those of splits."""
    return sorted({*folder.glob(f"**/{_LABELS}/**/*.txt")})


def _with_images(texts: Sequence[Path]) -> list[tuple[Path, Path]]:
    return [(text, image) for text in texts if (image := image_of(text)) is not None]


def read_yolo_labels(folder: Path, names: Path | None) -> ImageLabels:
    """Reads `class cx cy w h` or `class x1 y1 ... xn yn` lines, as shares of the image's sides.

    Four corners are kept; any other polygon becomes the upright box around it. Without class names,
    only one may occur. Texts lie in the folder, in its `labels`, or else in folders called `labels`
    below it. Those without an image of their name, such as a read-me, are skipped.
    """
    classes = None if names is None else _classes(names)
    images = LabelledImages(folder, "centre x, centre y, width, height as shares of the image")
    root = folder / _LABELS
    beside = label_texts(root if root.is_dir() else folder)
    for text, image in _with_images(beside) or _with_images(split_texts(folder)):
        size_px = image_size_px(image)
        images.add_image(image.stem, size_px)
        for where, words in text_lines(text):
            images.add(image.stem, _yolo_label(where, words, classes, size_px), where)
    if not images.labels:
        raise ImageryError(
            f"{folder} holds no label text (.txt) with an image of the same name; put the images "
            f"beside the texts, or into a folder {IMAGE_FOLDERS[0]} beside their folder {_LABELS}, "
            "or give another folder."
        )
    if classes is not None:
        return images.with_classes(classes)
    found = images.classes_found
    if len(found) > 1:
        raise ImageryError(
            f"{folder} lists no names of its {len(found)} classes ({', '.join(found)[:200]}); add "
            "data.yaml, a .names file or classes.txt."
        )
    note = f"{folder} lists no names of classes: its only one is called {', '.join(found)!r}"
    return images.with_classes(found, note)


def _yolo_label(
    where: str, words: list[str], classes: Sequence[str] | None, size_px: tuple[int, int]
) -> Label:
    numbers = label_numbers(words)
    if not _is_shape(numbers[1:]):
        raise damaged(where, "is not 'class cx cy w h' or 'class x1 y1 ... xn yn'")
    index, *values = numbers
    if index != int(index) or index < 0 or (classes is not None and index >= len(classes)):
        known = "" if classes is None else f" but there are {len(classes)} names"
        raise damaged(where, f"has class {index:g}{known}")
    class_name = f"class {index:g}" if classes is None else classes[int(index)]
    if len(values) == 4:
        x, y, width, height = values
        box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        shares = Label.upright("", box).corners
    else:
        shares = outline_corners([*zip(values[::2], values[1::2], strict=True)])
    return Label(class_name, tuple((x * size_px[0], y * size_px[1]) for x, y in shares))


def _classes(path: Path) -> list[str]:
    text = read_text(path)
    is_yaml = path.suffix == ".yaml"
    names = _yaml_names(text, path) if is_yaml else [line.strip() for line in text.splitlines()]
    while names and not names[-1]:
        names.pop()
    # An empty line counts, since labels refer to classes by their place in the list.
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
