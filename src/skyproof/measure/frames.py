"""Annotated frames of cameras, named on the command line."""

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
class _FramesArgument:
    name: str
    folder: Path
    pattern: str
    labels: Path | None
    gsd_m: float
    classes: tuple[str, ...]

    @property
    def border_px(self) -> float:
        """The unlabelled border: none in our own datasets, where every vehicle is labelled."""
        ours = self.labels is None and (self.folder / "annotations.json").is_file()
        return 0.0 if ours else BORDER_PX


def read_frames(texts: Sequence[str], classes: Sequence[str], gsd_m: float) -> list[BaselineSet]:
    """Reads frames given as `[NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...]`.

    An example is `kit/MOS*@0.116#car,minibus`. Without classes of its own a set has `classes`.
    LABELS (COCO file, folder of YOLO or DOTA text) is needed if they do not lie with the images.
    Arguments of the same NAME are one set. Each argument counts as one place; in a set that
    `skyproof ground` cut, each source.
    """
    by_name: dict[str, list[_FramesArgument]] = {}
    for text in texts:
        given = _parse(text, tuple(classes))
        by_name.setdefault(given.name, []).append(given)
    return [_read(name, given, gsd_m) for name, given in by_name.items()]


def _read(name: str, given: Sequence[_FramesArgument], gsd_m: float) -> BaselineSet:
    parts, places = [], []
    for number, one in enumerate(given, 1):
        read = read_frames_folder(
            one.folder,
            labels=one.labels,
            gsd_m=one.gsd_m,
            target_gsd_m=gsd_m,
            classes=one.classes,
            border_px=one.border_px,
            pattern=one.pattern,
        )
        parts.append(read)
        places += _sources(one.folder, read.ids) or [str(number)] * len(read)
    own_gsd = " and ".join(dict.fromkeys(f"{one.gsd_m * 100:.1f}" for one in given))
    rendered = any((one.folder / "scenes.jsonl").exists() for one in given)
    border = f"; {BORDER_PX:.0f} px border ignored" if any(one.border_px for one in given) else ""
    counted = ", ".join(dict.fromkeys(each for one in given for each in one.classes))
    note = (
        f"{'rendered' if rendered else 'real'} frames, {own_gsd} cm/px resampled to "
        f"{gsd_m * 100:.1f} cm/px; vehicles: {counted}{border}"
    )
    images = Dataset.joined(parts)
    return BaselineSet(name, images, real=not rendered, note=note, places=tuple(places))


def _parse(text: str, classes: tuple[str, ...]) -> _FramesArgument:
    place, _, resolution = text.rpartition("@")
    resolution, _, own = resolution.partition("#")
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
    named = tuple(filter(None, own.split(","))) or classes
    return _FramesArgument(name or shown, folder, pattern, labels, own_gsd_m, named)


def _sources(folder: Path, ids: Sequence[str]) -> list[str]:
    """The source of each image of a split of a tiled set; empty for another folder."""
    if not (folder.parent / "index.json").is_file():
        return []
    tiles = BackgroundSet.open(folder.parent)
    return [tiles.tile(name).source for name in ids]
