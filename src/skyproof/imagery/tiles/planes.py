"""Lays photographs without georeference that show the same ground in one plane."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np
import torch
from affine import Affine
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rasterio.enums import Resampling
from rasterio.io import DatasetReader
from rasterio.windows import Window
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from skyproof.imagery.labels.label import ImageLabels, Labels
from skyproof.imagery.rasters import is_faster_whole
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles import shared_ground
from skyproof.imagery.tiles.georeference import COARSEST_GSD_M, Georeference
from skyproof.imagery.tiles.shared_ground import CoarseView, PhotographPair, find_pairs
from skyproof.imagery.tiles.sources import (
    Source,
    SourceReader,
    holds_data,
    inspect_sources,
    read_mask,
)

COARSE_PX = 160
"""Smaller side of most photographs when they are compared."""
MOST_COARSE_PX = 1024
LARGEST_MISFIT_M = 2.0
"""A pair that is off by more in the plane of all contradicts the others."""
ALIGNED_RAD = math.radians(5.0)
WRONG_SCALE = 1.1
MANY = 100
"""Number of photographs from which their comparison shows its progress."""

_Pose = tuple[complex, complex]
"""Turn (with growth) and shift in metres that take a photograph to its plane."""
_Value = TypeVar("_Value", bound=np.generic)


def inspect_imagery(
    paths: Sequence[Path],
    settings: SourceSettings,
    labels: Labels | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> list[Source]:
    """Finds out how to read images (`inspect_sources`), and which show the same ground.

    Those without georeference that do are placed in one plane. Labelled objects do not count as
    ground: vehicles look alike, and move. With many images, `progress` gets (steps done, all): each
    is read, then compared with the others.
    """
    sources = inspect_sources(paths, settings)
    alone = [i for i, source in enumerate(sources) if source.georeference.crs is None]
    if len(alone) < 2:
        return sources
    progress = progress if len(alone) >= MANY else lambda *_: None
    usual_m = median(sources[i].smaller_side_m for i in alone) / COARSE_PX
    views = []
    with SourceReader() as reader, ThreadPoolExecutor(torch.get_num_threads()) as pool:
        pixel_m = min(usual_m, COARSEST_GSD_M)
        # Read by one thread, because threads must not share GDAL's open files.
        pictures = (_coarse_picture(sources[i], reader, pixel_m, labels) for i in alone)
        for number, view in enumerate(pool.map(lambda each: CoarseView.of(*each), pictures), 1):
            views.append(dataclasses.replace(view, stood=sources[alone[number - 1]].exif.place))
            progress(number, 2 * len(alone))
    pairs = find_pairs(views, lambda done, every: progress(every + done, 2 * every))
    poses, groups = _poses(len(views), pairs)
    shared = list(sources)
    neighbours = shared_ground.MOST_NEIGHBOURS
    for group in groups:
        for number in group:
            source, (turn, shift) = sources[alone[number]], poses[number]
            notes = [*source.notes]
            if len(alone) > neighbours + 1:
                notes.append(
                    f"compared with the {neighbours} before and after in the order of their names "
                    "alone, so that ground which shows again later counts twice"
                )
            georeference = source.georeference
            if len(group) > 1:
                plane = sources[alone[group[0]]].path.stem
                georeference = _in_plane(georeference, turn, shift, plane)
            if abs(math.log(abs(turn))) > math.log(WRONG_SCALE):
                notes.append(
                    "a pixel is over 10 % larger or smaller than given, beside others of the same "
                    "ground, and is taken so; check the resolution"
                )
            shared[alone[number]] = dataclasses.replace(
                source, georeference=georeference, notes=tuple(notes)
            )
    return shared


def _coarse_picture(
    source: Source, reader: SourceReader, usual_m: float, labels: Labels | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """Reads a photograph at the usual scale, or coarser if it is very large or has no finer one.

    Returns its brightness and usable pixels, `[H, W]`, and metres per pixel.
    """
    gsd_m = source.georeference.gsd_m
    sides_m = source.width_px * gsd_m[0], source.height_px * gsd_m[1]
    pixel_m = max(usual_m, *gsd_m, max(sides_m) / MOST_COARSE_PX)
    across, down = (max(1, round(side_m / pixel_m)) for side_m in sides_m)
    shape = (across, down) if source.stored.b else (down, across)
    with reader.reading(source.path) as dataset:
        bands = sorted({*source.bands})
        values = _averaged(dataset, bands, shape)
        whole = Window(0, 0, dataset.width, dataset.height)
        usable = (read_mask(dataset, source, whole, shape) > 0) & holds_data(values)
    low, high = source.value_range or (0.0, 255.0)
    grey = np.clip((values.astype(np.float32).mean(0) - low) / (high - low), 0, 1)
    grey = np.where(usable, grey, grey[usable].mean() if usable.any() else 0).astype(np.float32)
    grey, usable = _upright(grey, source.stored), _upright(usable, source.stored)
    if isinstance(labels, ImageLabels):
        usable = usable & ~_labelled(source, labels, usable.shape)
    return grey, usable, pixel_m


def _averaged(
    dataset: DatasetReader, bands: Sequence[int], shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Reads bands at a coarser scale, `[bands, H, W]`."""
    if not is_faster_whole(dataset):
        size = len(bands), *shape
        return dataset.read(bands, out_shape=size, resampling=Resampling.average)
    pictures = map(Image.fromarray, dataset.read(bands).astype(np.float32))
    smaller = (picture.resize(shape[::-1], Image.Resampling.BOX) for picture in pictures)
    return np.stack([np.asarray(picture) for picture in smaller])


def _upright(stored: NDArray[_Value], transform: Affine) -> NDArray[_Value]:
    """Turns a stored picture `[H, W]` upright."""
    upright = stored.T if transform.b else stored
    across = -1 if transform.a + transform.b < 0 else 1
    down = -1 if transform.d + transform.e < 0 else 1
    return np.ascontiguousarray(upright[::down, ::across])


def _labelled(source: Source, labels: ImageLabels, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Returns the pixels of a coarse picture that labelled objects cover."""
    canvas = Image.new("1", shape[::-1])
    draw = ImageDraw.Draw(canvas)
    scale = shape[1] / source.width_px, shape[0] / source.height_px
    for label in labels.images.get(source.path.stem, ()):
        draw.polygon([(x * scale[0], y * scale[1]) for x, y in label.corners], fill=1, outline=1)
    return np.asarray(canvas)


def _poses(count: int, pairs: Sequence[PhotographPair]) -> tuple[list[_Pose], list[list[int]]]:
    """Finds turn and shift of every photograph in the plane of its group, and the groups.

    Pairs that contradict the others are dropped, the worst first.
    """
    while True:
        joined = DisjointSet(range(count))
        for pair in pairs:
            joined.merge(pair.first, pair.second)
        groups = [sorted(numbers) for numbers in joined.subsets()]
        poses = _solve(count, pairs, {group[0] for group in groups})
        if not pairs:
            break
        misfits_m = [_misfit_m(pair, poses) for pair in pairs]
        # A wrong pair distorts those around it, so only the worst are dropped at a time.
        limit_m = max(LARGEST_MISFIT_M, 0.9 * max(misfits_m))
        kept = [pair for pair, off in zip(pairs, misfits_m, strict=True) if off <= limit_m]
        if len(kept) == len(pairs):
            break
        pairs = kept
    for group in groups:
        turn, shift = poses[_reference(group, poses)]
        for number in group:
            its_turn, its_shift = poses[number]
            poses[number] = its_turn / turn, (its_shift - shift) / turn
    return poses, groups


def _solve(count: int, pairs: Sequence[PhotographPair], fixed: set[int]) -> list[_Pose]:
    """Lays all photographs by least squares over the places of all pairs; some stay fixed.

    A turn with growth is a factor of complex numbers, so that all equations are linear.
    """
    rows: list[tuple[int, int, complex]] = []
    places = [(pair, place) for pair in pairs for place in pair.places]
    for number, (pair, place) in enumerate(places):
        in_first = pair.turn * place + pair.shift
        rows += [(number, 2 * pair.first, in_first), (number, 2 * pair.first + 1, 1)]
        rows += [(number, 2 * pair.second, -place), (number, 2 * pair.second + 1, -1)]
    answer = np.tile(np.array([1, 0], complex), count)
    free = np.array([i for i in range(2 * count) if i // 2 not in fixed], int)
    if rows:
        row, column, value = zip(*rows, strict=True)
        shape = (2 * len(pairs), 2 * count)
        equations = coo_array((np.array(value, complex), (row, column)), shape=shape).tocsc()
        part = equations[:, free]
        still = np.zeros(2 * count, complex)
        still[[2 * i for i in fixed]] = 1
        conjugate = part.conj().T
        answer[free] = spsolve((conjugate @ part).tocsc(), -(conjugate @ (equations @ still)))
    return [(complex(turn), complex(shift)) for turn, shift in answer.reshape(-1, 2)]


def _misfit_m(pair: PhotographPair, poses: Sequence[_Pose]) -> float:
    """Returns how far a pair's places are from each other in the plane."""
    (turn, shift), (other_turn, other_shift) = poses[pair.first], poses[pair.second]
    return max(
        abs(turn * (pair.turn * place + pair.shift) + shift - other_turn * place - other_shift)
        for place in pair.places
    )


def _reference(group: Sequence[int], poses: Sequence[_Pose]) -> int:
    """Chooses the photograph whose sides and scale are most like those of the others."""
    turns = np.array([poses[number][0] for number in group])
    quarter = (turns / np.abs(turns)) ** 4
    likewise = (np.abs(np.angle(quarter[:, None] / quarter)) < 4 * ALIGNED_RAD).sum(1)
    aligned = np.flatnonzero(likewise == likewise.max())
    off = np.abs(np.log(np.abs(turns[aligned]) / np.median(np.abs(turns))))
    return group[aligned[off.argmin()]]


def _in_plane(
    georeference: Georeference, turn: complex, shift: complex, plane: str
) -> Georeference:
    """Returns a place in the plane, whose x axis runs to the right and whose y axis runs up."""
    across_m, down_m = georeference.gsd_m
    x, y = turn * across_m, turn * 1j * down_m
    transform = Affine(x.real, y.real, shift.real, -x.imag, -y.imag, -shift.imag)
    size = abs(turn)
    return Georeference(None, transform, (across_m * size, down_m * size), plane)
