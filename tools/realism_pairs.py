"""Windows around photographed vehicles and around those drawn in their places, for realism.py.

Nothing but what was drawn may tell the two windows of a pair apart. Both show the same ground, cut
from one tile at the same pixels; both hide the same pixels, and both belong to one place. So
ground, frame and the shape of a mask say nothing of which of the two was drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from torch import Tensor

from skyproof.datasets.annotations import AnnotationFile, AnnotationRow, read_annotations
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS

Array = NDArray[np.float64]

WINDOW_M = 7.0
"""How much a network sees across: a car, its shadow and some ground."""
ROOM_M = 0.5
"""How far windows are shifted at random, on both axes."""
COARSEST_M = 0.3
"""Metres per pixel; where pixels are larger a car is too small for the network."""

_MARGIN_M = 0.4  # around a vehicle's ground, for what leans out of it and for labels that are off
_SAME_PLACE_M = 1.5
_UNKNOWN_M = 5.0  # side of the square that is hidden where a heading is not known
_PEAK = 15.0  # of a correlation, in its standard deviations: chance alone reaches about 5
_EARLIER = 3  # tiles that a tile is laid over


class _Row(AnnotationRow, kw_only=True, frozen=True):
    """An annotation with what was drawn, and the ground it stands on."""

    vehicle: str | None = None
    corners_px: tuple[tuple[float, float], ...] | None = None


class _File(AnnotationFile, kw_only=True, frozen=True):
    """The annotation file of a rendered dataset."""

    annotations: tuple[_Row, ...]


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture of a tile, or of a part of it.

    Attributes:
        tile: its id.
        pixels: `[3, H, W]` sRGB bytes, in the tile's orientation.
        corner_px: where the picture begins in the tile, from the left and from the top.
        vehicles: `[n, 5]` the ground that vehicles stand on: column and row of the middle in the
            tile, heading from right towards down (radians), length and width, in pixels.
        names: `[n]` of the vehicles in their fleet; empty where photographed.
        others: `[m, 5]` ground in the same form on which something else stands.
    """

    tile: str
    pixels: Tensor
    corner_px: tuple[int, int]
    vehicles: Array
    names: Sequence[str]
    others: Array


@dataclass(frozen=True, eq=False)
class Pairs:
    """Windows in pairs: first what is real, then what was rendered in its place.

    Attributes:
        pixels: `[N, 2, 3, S, S]` sRGB bytes; S is the window with room for shifts on all sides.
        vehicle: `[N, S, S]` where the vehicle of either window is.
        hidden: `[N, S, S]` where other vehicles of either window are.
        positions_m: `[N, 2]` of the windows' middles on their ground, right and down.
        grounds: `[N]` which ground that is; positions on one can be compared.
        names: `[N, 2]` vehicles of the fleet; empty where photographed.
        gsd_m: metres per pixel.
        left_out: how many pairs the border of a picture was too near to.
    """

    pixels: Tensor
    vehicle: Tensor
    hidden: Tensor
    positions_m: Array
    grounds: NDArray[np.int64]
    names: NDArray[np.str_]
    gsd_m: float
    left_out: int = 0


def read_pairs(real: Sequence[Path], rendered: Sequence[Path], cleared: Path) -> Pairs:
    """Cuts the windows of all vehicles that stand in the same place on both sides.

    Args:
        real: the labelled tiled folder that `cleared` was made of, or rendered datasets: then
            renders are compared with renders.
        rendered: datasets that `skyproof render` wrote.
        cleared: what `skyproof clear` made, on which the vehicles were rendered.

    Raises:
        ConfigurationError: pixels are too large, or there is no pair.
        SkyproofError: a folder is missing or damaged, or was rendered on something else.
    """
    ground = BackgroundSet.open(cleared)
    if ground.gsd_m > COARSEST_M:
        raise ConfigurationError(
            f"--cleared expects {COARSEST_M} metres per pixel or less, got {ground.gsd_m}; cut "
            "finer tiles."
        )
    firsts: dict[str, list[Shown]] = {}
    for folder in real:
        for shown in _shown(folder, ground):
            firsts.setdefault(shown.tile, []).append(shown)
    windows = []
    left_out = 0
    turn = 0
    for folder in rendered:
        for second in _shown(folder, ground):
            partners = firsts.get(second.tile, [])
            if partners:
                turn += 1
                cut, missed = _pairs_of(partners[turn % len(partners)], second, ground.gsd_m)
                windows += [(second.tile, *window) for window in cut]
                left_out += missed
    if not windows:
        raise ConfigurationError(
            "Expected vehicles in the same places on both sides, got none; render scenes with "
            "--settings.places removed, as large as the tiles."
        )
    tiles = [window[0] for window in windows]
    grounds, shift_px = _laid_over(ground, list(dict.fromkeys(tiles)))
    middles = np.array([window[1] for window in windows])
    return Pairs(
        pixels=torch.stack([window[3] for window in windows]),
        vehicle=torch.from_numpy(np.stack([window[4] for window in windows])),
        hidden=torch.from_numpy(np.stack([window[5] for window in windows])),
        positions_m=(middles + [shift_px[tile] for tile in tiles]) * ground.gsd_m,
        grounds=np.array([grounds[tile] for tile in tiles]),
        names=np.array([window[2] for window in windows]),
        gsd_m=ground.gsd_m,
        left_out=left_out,
    )


def _shown(folder: Path, ground: BackgroundSet) -> Iterator[Shown]:
    return (
        _photographed(folder, ground)
        if (folder / "index.json").exists()
        else _rendered(folder, ground)
    )


def _photographed(folder: Path, ground: BackgroundSet) -> Iterator[Shown]:
    """Gives a labelled tiled folder's pictures, with the vehicles that were cleared from them."""
    photographs = BackgroundSet.open(folder)
    unknown_px = _UNKNOWN_M / ground.gsd_m
    for split in SPLITS:
        if not photographs.tiles(split):
            continue
        labels = Dataset.open(folder / split)
        ignored = dict(zip(labels.ids, labels.ignore, strict=True))
        for tile in ground.tiles(split):
            if tile.id not in ignored:
                raise ConfigurationError(
                    f"{folder} has no labelled tile {tile.id}; give the tiles that --cleared was "
                    "made of."
                )
            known = []
            others = [
                ((left + right) / 2, (top + bottom) / 2, 0.0, right - left, bottom - top)
                for left, top, right, bottom in ignored[tile.id].tolist()
            ]
            for place in tile.removed:
                if place.heading_rad is None or not (place.length_m and place.width_m):
                    others.append((place.x_px, place.y_px, 0.0, unknown_px, unknown_px))
                    continue
                sides = (place.length_m / ground.gsd_m, place.width_m / ground.gsd_m)
                known.append((place.x_px, place.y_px, -place.heading_rad, *sides))
            yield Shown(
                tile.id,
                photographs.pixels(tile.id),
                (0, 0),
                np.reshape(known, (-1, 5)),
                [""] * len(known),
                np.reshape(others, (-1, 5)),
            )


def _rendered(folder: Path, ground: BackgroundSet) -> Iterator[Shown]:
    """Gives a rendered dataset's pictures, turned as their tiles are."""
    document, _ = read_annotations(folder, _File)
    dataset = Dataset.open(folder)
    rows: dict[int, list[_Row]] = {image.id: [] for image in document.images}
    for row in document.annotations:
        rows[row.image_id].append(row)
    for index, (scene, own) in enumerate(zip(dataset.scenes, rows.values(), strict=True)):
        window = scene.background
        ground.tile(window.tile)
        half = scene.camera.size_px / 2
        quarters = round(window.rotation_rad / (math.pi / 2))
        corner = (window.centre_x_px - half, window.centre_y_px - half)
        whole = corner[0].is_integer() and corner[1].is_integer()
        if window.rotation_rad != quarters * math.pi / 2 or not whole:
            raise ConfigurationError(
                f"{folder} shows its ground resampled; render scenes as large as the tiles, which "
                "are turned by quarters only."
            )
        cosine = math.cos(window.rotation_rad)
        sine = math.sin(window.rotation_rad)
        vehicles = []
        for row in own:
            if row.corners_px is None:
                raise ConfigurationError(
                    f"{folder} does not say on which ground its vehicles stand; render it again."
                )
            # Front left, front right, rear right, rear left, from the picture's middle.
            corners = np.array(row.corners_px) - half
            x, y = corners.T
            corners = np.stack([cosine * x + sine * y, cosine * y - sine * x], 1)
            along = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
            across = corners[1] - corners[0]
            middle = corners.mean(0) + np.array([window.centre_x_px, window.centre_y_px])
            heading = math.atan2(along[1], along[0])
            vehicles.append((*middle, heading, np.hypot(*along), np.hypot(*across)))
        yield Shown(
            window.tile,
            dataset.image(index).rot90(quarters, (1, 2)),
            (int(corner[0]), int(corner[1])),
            np.reshape(vehicles, (-1, 5)),
            [row.vehicle or "" for row in own],
            np.zeros((0, 5)),
        )


Window = tuple[Array, tuple[str, str], Tensor, NDArray[np.bool_], NDArray[np.bool_]]


def _pairs_of(first: Shown, second: Shown, gsd_m: float) -> tuple[list[Window], int]:
    """Cuts the pairs of two pictures of one tile; and counts those that a border cuts."""
    distance_m = cdist(first.vehicles[:, :2], second.vehicles[:, :2]) * gsd_m
    windows = []
    missed = 0
    for i, j in zip(*linear_sum_assignment(np.minimum(distance_m, 10.0)), strict=True):
        if distance_m[i, j] > _SAME_PLACE_M:
            continue
        own = np.stack([first.vehicles[i], second.vehicles[j]])
        middle = own[:, :2].mean(0)
        room = round(ROOM_M / gsd_m)
        side = 2 * (round(WINDOW_M / gsd_m / 2) + room)
        corner = np.floor(middle).astype(int) - side // 2
        cuts = [_cut(shown, corner, side) for shown in (first, second)]
        pixels = [cut for cut in cuts if cut is not None]
        if len(pixels) < len(cuts):
            missed += 1
            continue
        others = np.concatenate(
            [
                np.delete(first.vehicles, i, 0),
                np.delete(second.vehicles, j, 0),
                first.others,
                second.others,
            ]
        )
        margin = _MARGIN_M / gsd_m
        hidden = covered(others, corner, side, margin) & ~covered(own, corner, side, 0.0)
        vehicle = covered(own, corner, side, margin) & ~hidden
        names = (first.names[i], second.names[j])
        windows.append((middle, names, torch.stack(pixels), vehicle, hidden))
    return windows, missed


def _cut(shown: Shown, corner: NDArray[np.int64], side: int) -> Tensor | None:
    left, top = (int(value) for value in corner - shown.corner_px)
    height, width = shown.pixels.shape[1:]
    if min(left, top) < 0 or left + side > width or top + side > height:
        return None
    return shown.pixels[:, top : top + side, left : left + side].clone()


def covered(
    rectangles: Array, corner: NDArray[np.int64], side: int, margin_px: float
) -> NDArray[np.bool_]:
    """Says which pixels of a window lie on rectangles that are grown on all sides.

    Args:
        rectangles: `[n, 5]` as in `Shown`.
        corner: the window's left and top edge in the tile.
        side: of the window in pixels.
        margin_px: by how much they are grown.
    """
    steps = np.arange(side) + 0.5
    x = corner[0] + steps[None, None, :] - rectangles[:, 0, None, None]
    y = corner[1] + steps[None, :, None] - rectangles[:, 1, None, None]
    heading, length, width = rectangles[:, 2:, None, None].transpose(1, 0, 2, 3)
    along = np.abs(x * np.cos(heading) + y * np.sin(heading)) <= length / 2 + margin_px
    across = np.abs(y * np.cos(heading) - x * np.sin(heading)) <= width / 2 + margin_px
    inside: NDArray[np.bool_] = (along & across).any(0)
    return inside


def _laid_over(
    ground: BackgroundSet, tiles: Sequence[str]
) -> tuple[dict[str, int], dict[str, Array]]:
    """Finds which tiles show the same ground, as frames of one flight do, by phase correlation.

    Each is laid over the three before it, in the order of their names.

    Returns:
        Per tile the number of its ground, and what is to be added to its pixels for the ground's.
    """
    grounds: dict[str, int] = {}
    shift_px: dict[str, Array] = {}
    pictures: list[tuple[str, Array]] = []
    for name in sorted(tiles):
        picture = ground.pixels(name).double().mean(0).numpy()
        grounds[name] = max(grounds.values(), default=-1) + 1
        shift_px[name] = np.zeros(2)
        for earlier, other in pictures[-_EARLIER:]:
            shift, peak = shift_between(other, picture)
            if peak >= _PEAK:
                grounds[name] = grounds[earlier]
                shift_px[name] = shift_px[earlier] + shift
        pictures.append((name, picture))
    return grounds, shift_px


def shift_between(first: Array, second: Array) -> tuple[Array, float]:
    """Returns what is to be added to places (x, y) in `second` for `first`'s, and how clear it is.

    Args:
        first, second: `[H, W]`, cut to the size that both have.
    """
    # Averaged over squares of two, which hides the blocks of JPEG and a car's shift of a pixel.
    height, width = (min(a, b) // 2 for a, b in zip(first.shape, second.shape, strict=True))
    taper = np.outer(np.hanning(height), np.hanning(width))
    spectra = []
    for picture in (first, second):
        small = picture[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean((1, 3))
        spectra.append(fft.rfft2((small - small.mean()) * taper))
    cross = spectra[0] * np.conj(spectra[1])
    surface = fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), (height, width))
    y, x = np.unravel_index(int(surface.argmax()), surface.shape)
    signed = [x - width if x > width // 2 else x, y - height if y > height // 2 else y]
    return 2.0 * np.array(signed), float(surface.max() / max(surface.std(), 1e-12))
