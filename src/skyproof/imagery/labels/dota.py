"""Reads DOTA text labels: one line an object, four corners in pixels, class and difficulty."""

from __future__ import annotations

from pathlib import Path

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import ImageLabels, Label, bounds, require_inside
from skyproof.imagery.labels.text import finite_numbers, image_of, image_size_px, text_lines
from skyproof.imagery.tiles.georeference import image_name

_HEADERS = ("imagesource:", "gsd:")


def is_dota_line(words: list[str]) -> bool:
    """Says whether a line is one of DOTA: a header, or eight numbers and a class that is none."""
    if words[0].lower().startswith(_HEADERS):
        return True
    try:
        finite_numbers(words[:8])
    except ValueError:
        return False
    if len(words) < 9:
        return False
    try:
        float(words[8])
    except ValueError:
        return True
    return False


def read_dota_labels(folder: Path) -> ImageLabels:
    """Reads `x1 y1 x2 y2 x3 y3 x4 y4 class difficult` lines, one `.txt` an image.

    Difficult objects are to be ignored.

    Header lines (`imagesource:`, `gsd:`) are skipped. Where the image lies beside its text, or in
    `images/` beside `labelTxt/`, its size is read and the labels are checked against it.

    Raises:
        ImageryError: a damaged line, or a box outside its image; names the file and the line.
    """
    images: dict[str, tuple[Label, ...]] = {}
    sizes_px: dict[str, tuple[int, int]] = {}
    for text in sorted(Path(folder).glob("*.txt")):
        image = image_of(text)
        name = text.stem if image is None else image_name(image)
        if image is not None:
            sizes_px[name] = image_size_px(image)
        labels = []
        for number, words in text_lines(text):
            if words[0].lower().startswith(_HEADERS):
                continue
            where = f"{text} line {number}"
            label = _label(where, words)
            if name in sizes_px:
                require_inside(label, sizes_px[name], where)
            labels.append(label)
        images[name] = tuple(labels)
    classes = sorted({label.class_name for labels in images.values() for label in labels})
    return ImageLabels(tuple(classes), images, sizes_px)


def _label(where: str, words: list[str]) -> Label:
    try:
        x1, y1, x2, y2, x3, y3, x4, y4 = finite_numbers(words[:8])
        # Some writers leave out the difficulty.
        if len(words) not in (9, 10) or words[9:] not in ([], ["0"], ["1"], ["2"]):
            raise ValueError
    except ValueError as error:
        raise ImageryError(
            f"{where} is not 'x1 y1 x2 y2 x3 y3 x4 y4 class difficult'; correct it."
        ) from error
    label = Label(
        words[8], ((x1, y1), (x2, y2), (x3, y3), (x4, y4)), ignore=words[9:] not in ([], ["0"])
    )
    left, top, right, bottom = bounds(label)
    if left >= right or top >= bottom:
        raise ImageryError(f"{where} has a box without size; correct it.")
    return label
