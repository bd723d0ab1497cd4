"""Real and rendered images with what is known of their places, for tools/realism.py."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from skyproof.cli.frames import read_frames
from skyproof.datasets.annotations import AnnotationFile, AnnotationRow, read_annotations
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import BackgroundWindow
from skyproof.scenes.splits import SPLITS

Tiles = dict[str, tuple[str, tuple[int, int]]]
"""Per tile the photograph that it was cut from, and where it begins there, in pixels."""


COARSEST_M = 0.3
"""Metres per pixel; where pixels are larger a car is too small for the network."""


class _Row(AnnotationRow, kw_only=True, frozen=True):
    """An annotation with the vehicle that was rendered."""

    vehicle: str | None = None


class _File(AnnotationFile, kw_only=True, frozen=True):
    """The annotation file of a rendered dataset."""

    annotations: tuple[_Row, ...]


@dataclass(frozen=True, eq=False)
class Shown:
    """An image with what is known of its place.

    Attributes:
        place: the name that the user gave.
        source: the photograph that its ground is cut from.
        pixels: `[3, H, W]` sRGB bytes.
        boxes, others: `[n, 4]` its vehicles, and its regions where nothing is scored.
        offset_px: where its tile begins in the source.
        window: of the tile, on which vehicles were rendered; None where the image is real.
        vehicles: of the fleet, per box; none where the image is real.
    """

    place: str
    source: str
    pixels: Tensor
    boxes: Tensor
    others: Tensor
    offset_px: tuple[int, int] = (0, 0)
    window: BackgroundWindow | None = None
    vehicles: tuple[str, ...] = ()

    @property
    def rendered(self) -> bool:
        """Whether a renderer drew vehicles into it."""
        return self.window is not None

    def in_source(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Says where points `[n, 2]` of the image lie in its source, in pixels."""
        own = points if self.window is None else in_tile(self.window, points, self.pixels.shape[1])
        return own + np.array(self.offset_px)


def in_tile(
    window: BackgroundWindow, points: NDArray[np.float64], size_px: int
) -> NDArray[np.float64]:
    """Says where points `[n, 2]` of a window of `size_px` lie in its tile, in pixels."""
    cosine = math.cos(window.rotation_rad)
    sine = math.sin(window.rotation_rad)
    x, y = (points - size_px / 2).T
    return np.stack(
        [window.centre_x_px + cosine * x + sine * y, window.centre_y_px - sine * x + cosine * y], 1
    )


def read_images(
    real: Sequence[str],
    rendered: Sequence[str],
    backgrounds: Sequence[Path],
    classes: Sequence[str],
) -> tuple[list[Shown], list[Shown], float]:
    """Reads all images.

    Args:
        real: as `skyproof check --frames` takes them.
        rendered: `NAME=FOLDER`, datasets that `skyproof render` wrote; NAME is that of the real
            images of the same place.
        backgrounds: background sets that say where the tiles of both lie.
        classes: of the real labels, those that count as vehicles.

    Returns:
        The real images, the rendered ones, and the metres per pixel of all.

    Raises:
        ConfigurationError: rendered sets of different or too coarse resolutions, or an argument of
            another form.
        SkyproofError: images or labels that cannot be read.
    """
    named = [_name_and_folder(text) for text in rendered]
    datasets = [Dataset.open(folder) for _, folder in named]
    resolutions = {dataset.gsd_m for dataset in datasets}
    if len(resolutions) != 1:
        raise ConfigurationError(
            f"--rendered expects datasets of one resolution, got {sorted(resolutions)} metres per "
            "pixel; render them on ground of one resolution."
        )
    gsd_m = resolutions.pop()
    if gsd_m > COARSEST_M:
        raise ConfigurationError(
            f"--rendered expects {COARSEST_M} metres per pixel or less, got {gsd_m}; render on "
            "finer ground."
        )
    tiles: Tiles = {
        tile.id: (Path(tile.source).stem, tile.offset_px)
        for background_set in map(BackgroundSet.open, backgrounds)
        for split in SPLITS
        for tile in background_set.tiles(split)
    }
    renders = [
        shown
        for (name, folder), dataset in zip(named, datasets, strict=True)
        for shown in _rendered_images(name, folder, dataset, tiles)
    ]
    return list(_real_images(real, classes, tiles, gsd_m)), renders, gsd_m


def _name_and_folder(text: str) -> tuple[str, Path]:
    name, separator, folder = text.partition("=")
    if not (name and separator and folder):
        raise ConfigurationError(
            f"--rendered expects NAME=FOLDER with the NAME of the real place, got {text!r}; write "
            "it like Town=runs/rendered."
        )
    return name, Path(folder)


def _real_images(
    texts: Sequence[str], classes: Sequence[str], tiles: Tiles, gsd_m: float
) -> Iterator[Shown]:
    for clean in read_frames(texts, classes, gsd_m):
        for index, name in enumerate(clean.images.ids):
            source, offset_px = tiles.get(name, (name, (0, 0)))
            yield Shown(
                clean.name,
                source,
                clean.images.image(index),
                clean.images.boxes[index],
                clean.images.ignore[index],
                offset_px,
            )


def _rendered_images(name: str, folder: Path, dataset: Dataset, tiles: Tiles) -> Iterator[Shown]:
    document, _ = read_annotations(folder, _File)
    vehicles: dict[int, list[str]] = {image.id: [] for image in document.images}
    for row in document.annotations:
        if not row.iscrowd:
            vehicles[row.image_id].append(row.vehicle or "")
    for index, (scene, drawn) in enumerate(zip(dataset.scenes, vehicles.values(), strict=True)):
        window = scene.background
        # Ground of elsewhere is a place of its own, one per tile.
        source, offset_px = tiles.get(window.tile, (f"tile {window.tile}", (0, 0)))
        yield Shown(
            name,
            source,
            dataset.image(index),
            dataset.boxes[index],
            torch.zeros(0, 4),
            offset_px,
            window,
            tuple(drawn),
        )
