"""Real annotated frames named on the command line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.imagery.frames import BORDER_PX, read_frames_folder
from skyproof.measure.baseline import BaselineSet
from skyproof.scenes.backgrounds import BackgroundSet


@dataclass(frozen=True)
class _Given:
    """One argument of --frames, taken apart."""

    name: str
    folder: Path
    pattern: str
    labels: Path | None
    gsd_m: float
    classes: tuple[str, ...]


def read_frames(texts: Sequence[str], classes: Sequence[str], gsd_m: float) -> list[BaselineSet]:
    """Reads frames given as `[NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...]`.

    An example is `kit/MOS*@0.116#car,minibus`. Without classes of its own a set has `classes`.
    LABELS (COCO file, folder of YOLO or DOTA text) is needed where they do not lie with the images.
    Arguments of the same NAME are one set. Each argument counts as one place; in a set that
    `skyproof ground` cut, each source.

    Raises:
        ConfigurationError: a text of another form.
        ImageryError: an image or label file that cannot be used.
    """
    by_name: dict[str, list[_Given]] = {}
    for text in texts:
        given = _parse(text)
        by_name.setdefault(given.name, []).append(given)
    return [_read(name, own, classes, gsd_m) for name, own in by_name.items()]


def _read(name: str, given: Sequence[_Given], classes: Sequence[str], gsd_m: float) -> BaselineSet:
    parts, places = [], []
    for number, one in enumerate(given, 1):
        read = read_frames_folder(
            one.folder,
            labels=one.labels,
            gsd_m=one.gsd_m,
            target_gsd_m=gsd_m,
            classes=one.classes or tuple(classes),
            border_px=_border_px(one),
            pattern=one.pattern,
        )
        parts.append(read)
        places += _sources(one.folder, read.ids) or [str(number)] * len(read)
    images = Dataset.joined(parts)
    own_gsd = " and ".join(dict.fromkeys(f"{one.gsd_m * 100:.1f}" for one in given))
    rendered = [one for one in given if (one.folder / "scenes.jsonl").exists()]
    bordered = any(map(_border_px, given))
    counted = dict.fromkeys(name for one in given for name in one.classes or classes)
    note = (
        f"{'rendered' if rendered else 'real'} frames, {own_gsd} cm/px resampled to "
        f"{gsd_m * 100:.1f} cm/px; vehicles: "
        f"{', '.join(counted)}{f'; {BORDER_PX:.0f} px border ignored' if bordered else ''}"
    )
    return BaselineSet(name, images, real=not rendered, note=note, places=tuple(places))


def _border_px(given: _Given) -> float:
    """Gives the unlabelled border: none in our own datasets, where every vehicle is labelled."""
    return (
        0.0 if given.labels is None and (given.folder / "annotations.json").is_file() else BORDER_PX
    )


def _parse(text: str) -> _Given:
    place, _, resolution = text.rpartition("@")
    resolution, _, classes = resolution.partition("#")
    name, place = re.fullmatch(r"(?:([^/=]+)=)?(.*)", place, re.S).groups("")  # type: ignore[union-attr]
    try:
        own_gsd_m = float(resolution)
    except ValueError:
        own_gsd_m = 0.0
    if not place or not 0 < own_gsd_m <= 0.5:
        raise ConfigurationError(
            "--frames expects [NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...] with metres per "
            f"pixel up to 0.5, got {text!r}; write it like my_frames@0.12."
        )
    labels = None
    if ":" in place and not Path(place).is_dir():
        place, _, elsewhere = place.rpartition(":")
        labels = Path(elsewhere)
    folder = Path(place)
    pattern = "*"
    if not folder.is_dir():
        folder, pattern = folder.parent, folder.name
        if not folder.is_dir() or not set(pattern) & set("*?["):
            raise ConfigurationError(f"{place} is not a folder; check --frames {text}.")
    shown = folder.resolve().name if pattern == "*" else f"{folder.resolve().name}/{pattern}"
    own = tuple(filter(None, classes.split(",")))
    return _Given(name or shown, folder, pattern, labels, own_gsd_m, own)


def _sources(folder: Path, ids: Sequence[str]) -> list[str]:
    """Gives per image its source, where the folder is one split of a tiled set; else nothing."""
    if not (folder.parent / "index.json").is_file():
        return []
    tiles = BackgroundSet.open(folder.parent)
    return [tiles.tile(name).source for name in ids]
