"""Reads labels as DOTA text."""

from pathlib import Path

from skyproof.imagery.labels.image_files import (
    LabelledImages,
    damaged,
    finite_numbers,
    image_of,
    image_size_px,
    text_lines,
)
from skyproof.imagery.labels.label import ImageLabels, Label

_DOTA_HEADERS = ("imagesource:", "gsd:")


def is_dota_line(words: list[str]) -> bool:
    """Tells whether a line is a DOTA header, or eight numbers and a class that is no number."""
    if words[0].lower().startswith(_DOTA_HEADERS):
        return True
    try:
        finite_numbers(words[:8])
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
    images = LabelledImages(folder)
    for text in sorted(folder.glob("*.txt")):
        image = image_of(text)
        images.add_image(text.stem, None if image is None else image_size_px(image))
        for where, words in text_lines(text):
            if not words[0].lower().startswith(_DOTA_HEADERS):
                images.add(text.stem, _dota_label(where, words), where)
    return images.with_classes(
        sorted({label.class_name for labels in images.labels.values() for label in labels})
    )


def _dota_label(where: str, words: list[str]) -> Label:
    try:
        x1, y1, x2, y2, x3, y3, x4, y4 = finite_numbers(words[:8])
        # Some writers leave out the difficulty.
        if len(words) not in (9, 10) or words[9:] not in ([], ["0"], ["1"], ["2"]):
            raise ValueError
    except ValueError as error:
        raise damaged(where, "is not 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult'") from error
    corners = (x1, y1), (x2, y2), (x3, y3), (x4, y4)
    return Label(words[8], corners, ignore=words[9:] not in ([], ["0"]))
