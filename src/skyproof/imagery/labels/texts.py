"""Reads labels as DOTA text or VisDrone text."""

from collections.abc import Iterator
from pathlib import Path

from skyproof.imagery.labels.image_files import (
    LabelledImages,
    damaged,
    image_of,
    image_size_px,
    label_numbers,
    label_texts,
    text_lines,
)
from skyproof.imagery.labels.label import ImageLabels, Label

_DOTA_HEADERS = ("imagesource:", "gsd:")
_VISDRONE_CLASSES = (
    *("ignored regions", "pedestrian", "people", "bicycle", "car", "van", "truck", "tricycle"),
    *("awning-tricycle", "bus", "motor", "others"),
)
"""By category, from https://github.com/VisDrone/VisDrone2018-DET-toolkit."""


def is_dota_line(words: list[str]) -> bool:
    """Returns whether a line is a DOTA header, or eight numbers and a class that is no number."""
    if words[0].lower().startswith(_DOTA_HEADERS):
        return True
    return len(words) > 8 and len(label_numbers(words[:8])) == 8 and not _is_number(words[8])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _lines(images: LabelledImages, folder: Path) -> Iterator[tuple[str, str, list[str]]]:
    """Adds the image of every text in a folder, and yields its name with those of `text_lines`."""
    for text in label_texts(folder):
        image = image_of(text)
        images.add_image(text.stem, None if image is None else image_size_px(image))
        for where, words in text_lines(text):
            yield text.stem, where, words


def read_dota_labels(folder: Path) -> ImageLabels:
    """Reads `x1 y1 ... x4 y4 class difficult` lines; difficult objects become ignore regions."""
    images = LabelledImages(folder, "x1 y1 ... x4 y4 in pixels")
    for name, where, words in _lines(images, folder):
        if not words[0].lower().startswith(_DOTA_HEADERS):
            images.add(name, _dota_label(where, words), where)
    return images.with_classes(images.classes_found)


def _dota_label(where: str, words: list[str]) -> Label:
    numbers = label_numbers(words[:8])
    # Some writers leave out the difficulty.
    known = len(words) > 8 and words[9:] in ([], ["0"], ["1"], ["2"])
    if not numbers or not known:
        raise damaged(where, "is not 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult'")
    corners = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    return Label(words[8], corners, ignore=words[9:] not in ([], ["0"]))


def is_visdrone_line(words: list[str]) -> bool:
    """Returns whether a line is eight numbers with commas."""
    return len(_visdrone_numbers(words)) == 8


def _visdrone_numbers(words: list[str]) -> list[float]:
    # Some lines of the public set end with a comma.
    return label_numbers("".join(words).removesuffix(",").split(","))


def read_visdrone_labels(folder: Path) -> ImageLabels:
    """Reads `left,top,width,height,score,category,truncation,occlusion` lines.

    Category 0 and score 0 are ignore regions.
    """
    images = LabelledImages(folder, "left, top, width, height in pixels")
    for name, where, words in _lines(images, folder):
        images.add(name, _visdrone_label(where, words), where)
    return images.with_classes(_VISDRONE_CLASSES[1:])


def _visdrone_label(where: str, words: list[str]) -> Label:
    numbers = _visdrone_numbers(words)
    if len(numbers) != 8 or numbers[4] not in (0, 1):
        form = "'left,top,width,height,score,category,truncation,occlusion' with a score of 0 or 1"
        raise damaged(where, f"is not {form}")
    left, top, width, height, score, category, _, _ = numbers
    if category not in range(len(_VISDRONE_CLASSES)):
        what = f"has category {category:g} but VisDrone's are 0 to {len(_VISDRONE_CLASSES) - 1}"
        raise damaged(where, what)
    box = (left, top, left + width, top + height)
    return Label.upright(_VISDRONE_CLASSES[int(category)], box, ignore=score == 0 or category == 0)
