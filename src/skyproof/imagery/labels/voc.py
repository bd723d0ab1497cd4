"""Reads labels as Pascal VOC XML."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from xml.etree.ElementTree import Element, ParseError

from skyproof.imagery.labels.image_files import (
    LabelledImages,
    damaged,
    image_of,
    image_size_px,
    label_numbers,
    label_texts,
    read_text,
)
from skyproof.imagery.labels.label import ImageLabels, Label
from skyproof.imagery.rasters import parsed_xml

_SIDES = ("xmin", "ymin", "xmax", "ymax")
_LONGEST_NAME = 200


def voc_files(folder: Path) -> Iterator[tuple[Path, Element]]:
    """Yields the annotations in a folder, parsed, without other XML, such as GDAL's."""
    for file in label_texts(folder, ".xml"):
        # Files of GDAL and ESRI beside images and vector files.
        if file.name.lower().endswith((".aux.xml", ".shp.xml")):
            continue
        try:
            root = parsed_xml(read_text(file))
        except (ParseError, ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())[:200]
            raise damaged(str(file), f"is not XML that is read ({reason})") from error
        if root.tag == "annotation":
            yield file, root


def read_voc_labels(folder: Path, files: list[tuple[Path, Element]]) -> ImageLabels:
    """Reads objects with an upright box; difficult ones become ignore regions.

    Pixels count from 1, and a box includes its last pixel. The image has the name of the annotation
    file if there is such an image, and otherwise the name that the file states, unless other
    files state it too.
    """
    images = LabelledImages(folder, "xmin, ymin, xmax, ymax in pixels")
    named = [PureWindowsPath((root.findtext("filename") or "").strip()).stem for _, root in files]
    counts = Counter(named)
    for (file, root), inside in zip(files, named, strict=True):
        image = image_of(file)
        name = inside if image is None and inside and counts[inside] == 1 else file.stem
        images.add_image(name, _size_px(root) or (None if image is None else image_size_px(image)))
        for number, row in enumerate(root.iterfind("object"), 1):
            where = f"{file} object {number}"
            images.add(name, _label(row, where), where)
    return images.with_classes(images.classes_found)


def _size_px(root: Element) -> tuple[int, int] | None:
    """Returns the stated size; writers that do not know it leave it out or write 0."""
    words = [(root.findtext(f"size/{side}") or "").strip() for side in ("width", "height")]
    width, height = (int(word) if word.isdecimal() and len(word) < 8 else 0 for word in words)
    return (width, height) if width and height else None


def _label(row: Element, where: str) -> Label:
    name = (row.findtext("name") or "").strip()
    if not 0 < len(name) <= _LONGEST_NAME:
        raise damaged(where, "has no name")
    sides = label_numbers([row.findtext(f"bndbox/{side}") or "" for side in _SIDES])
    if not sides:
        raise damaged(where, f"has no bndbox of numbers ({', '.join(_SIDES)})")
    left, top, right, bottom = sides
    difficult = (row.findtext("difficult") or "0").strip().lower()
    if difficult not in ("0", "1", "false", "true"):
        raise damaged(where, f"is difficult as {difficult[:40]!r}, not 0 or 1")
    return Label.upright(name, (left - 1, top - 1, right, bottom), difficult in ("1", "true"))
