"""Finds points of photographs that can be recognised at any heading, scale and brightness.

Source: SIFT (Lowe 2004, https://doi.org/10.1023/B:VISI.0000029664.99615.94), with the square roots
of Arandjelović and Zisserman (2012, https://doi.org/10.1109/CVPR.2012.6248018). On drawn ground it
finds as many pairs as scikit-image's SIFT, as fast, without its three packages. Places are those of
whole pixels, and all points of an octave are described at once.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Complex = NDArray[np.complex128]
Numbers = NDArray[np.int64]
Picture = NDArray[np.float32]

FIRST_SIGMA_PX = 1.6
STEPS = 3
"""Blurs per octave."""
SMALLEST_PX = 24
LEAST_CONTRAST = 0.003
LARGEST_EDGE_RATIO = 10.0
BINS = 36
"""Of 10 degrees, for a point's heading."""
STRONG_SHARE = 0.8
"""A heading with this share of the strongest one's weight gives a point of its own."""
REACH_SIGMAS = 6.0
"""Half the side of the square that describes a point."""
SIDE, CELLS, HEADINGS = 16, 4, 8
"""Samples and cells along the side of that square, and headings in each cell."""
LARGEST_VALUE = 0.2

_ALONG = ((np.arange(SIDE) + 0.5) / SIDE * 2 - 1).astype(np.float32)
_SQUARE: Complex = (_ALONG[None] + 1j * _ALONG[:, None]).ravel()
_SIGMAS_PX = FIRST_SIGMA_PX * 2 ** (np.arange(STEPS + 3) / STEPS)


@dataclass(frozen=True)
class Keypoints:
    """Points of a picture, x right and y down as complex numbers in pixels.

    Attributes:
        places: `[n]`.
        sizes: blur times e^(i heading), `[n]`.
        descriptors: unit vectors, `[n, 128]`.
    """

    places: Complex
    sizes: Complex
    descriptors: Picture


@dataclass(frozen=True)
class _Octave:
    """Blurred pictures of one size, and what stands out there: level, row, column, strength."""

    levels: Picture
    points: tuple[Numbers, Numbers, Numbers, Picture]


def find_keypoints(grey: Picture, usable: NDArray[np.bool_], most: int) -> Keypoints:
    """Finds the strongest points of a picture `[H, W]`, at most about `most`, where it is usable.

    A point with several headings counts several times.
    """
    octaves: list[_Octave] = []
    # A photograph is blurred by half a pixel already.
    blurred = ndimage.gaussian_filter(grey, math.sqrt(FIRST_SIGMA_PX**2 - 0.5**2))
    while min(blurred.shape) >= SMALLEST_PX:
        octaves.append(_octave(blurred, usable))
        blurred, usable = octaves[-1].levels[STEPS, ::2, ::2], usable[::2, ::2]
    strengths = np.sort(np.concatenate([[0.0], *(each.points[-1] for each in octaves)]))
    weakest = strengths[-min(most, len(strengths))]
    found = [_described(octave, 2**number, weakest) for number, octave in enumerate(octaves)]
    none = np.zeros(0, complex), np.zeros(0, complex), np.zeros((0, CELLS**2 * HEADINGS))
    places, sizes, descriptors = zip(none, *found, strict=True)
    return Keypoints(
        np.concatenate(places), np.concatenate(sizes), np.concatenate(descriptors, dtype=np.float32)
    )


def _octave(blurred: Picture, usable: NDArray[np.bool_]) -> _Octave:
    levels = [blurred]
    for before, after in itertools.pairwise(_SIGMAS_PX):
        more = math.sqrt(after**2 - before**2)
        levels.append(ndimage.gaussian_filter(levels[-1], more, truncate=3.0))
    stack = np.stack(levels)
    differences = np.diff(stack, axis=0)
    inner = (slice(1, -1),) * 3
    stands_out = np.zeros(differences[inner].shape, bool)
    for signed in (differences, -differences):
        highest = signed
        for axis in range(3):
            length = highest.shape[axis] - 2
            parts = [highest.take(range(i, i + length), axis) for i in range(3)]
            highest = np.maximum(np.maximum(parts[0], parts[1]), parts[2])
        stands_out |= (signed[inner] == highest) & (highest > LEAST_CONTRAST)
    level, row, column = (each + 1 for each in np.nonzero(stands_out & usable[1:-1, 1:-1]))
    here = differences[level, row, column]
    across, down = (
        differences[level, row + j, column + i] + differences[level, row - j, column - i] - 2 * here
        for i, j in ((1, 0), (0, 1))
    )
    corners = [differences[level, row + j, column + i] for i in (-1, 1) for j in (-1, 1)]
    mixed = (corners[3] + corners[0] - corners[1] - corners[2]) / 4
    # A point on an edge could lie anywhere along it.
    determinant = across * down - mixed**2
    limit = (LARGEST_EDGE_RATIO + 1) ** 2 / LARGEST_EDGE_RATIO
    good = (determinant > 0) & ((across + down) ** 2 < limit * determinant)
    return _Octave(stack, (level[good], row[good], column[good], np.abs(here[good])))


def _described(octave: _Octave, pixel: int, weakest: float) -> tuple[Complex, Complex, Picture]:
    """Returns places, sizes and descriptors of an octave's points that are strong enough."""
    level, row, column, strength = octave.points
    chosen = strength >= weakest
    level = level[chosen]
    place: Complex = (column + 1j * row)[chosen]
    down, right = np.gradient(octave.levels[: STEPS + 1], axis=(1, 2))
    slopes = np.asarray(right + 1j * down, np.complex128)
    # The heading comes from a square of half the side.
    reach = REACH_SIGMAS * _SIGMAS_PX[level]
    around: Complex = place[:, None] + reach[:, None] / 2 * _SQUARE
    point, heading = _headings(_read(slopes, level, around))
    level, place = level[point], place[point]
    turn: Complex = np.exp(1j * heading)
    around = place[:, None] + (reach[point] * turn)[:, None] * _SQUARE
    turned: Complex = _read(slopes, level, around) * turn.conj()[:, None]
    sizes: Complex = pixel * _SIGMAS_PX[level] * turn
    return pixel * (place + 0.5 + 0.5j), sizes, _descriptors(turned)


def _read(slopes: Complex, level: Numbers, places: Complex) -> Complex:
    """Reads slopes at the nearest pixels, `[n, samples]`; beyond the border they are 0."""
    height, width = slopes.shape[1:]
    rows, columns = (np.rint(part).astype(np.int64) for part in (places.imag, places.real))
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return inside * slopes[level[:, None], rows.clip(0, height - 1), columns.clip(0, width - 1)]


def _headings(around: Complex) -> tuple[Numbers, NDArray[np.floating]]:
    """Returns the strongest headings of the slopes around points: numbers of points, radians."""
    weights = np.abs(around) * np.exp(-2 * np.abs(_SQUARE) ** 2)
    bins = np.floor(np.angle(around) / (2 * math.pi) * BINS).astype(np.int64) % BINS
    flat = np.arange(len(around))[:, None] * BINS + bins
    counted = np.bincount(flat.ravel(), weights.ravel(), len(around) * BINS)
    histogram = counted.astype(np.float64).reshape(-1, BINS)
    for _ in range(3):
        histogram = (np.roll(histogram, 1, 1) + histogram + np.roll(histogram, -1, 1)) / 3
    before, after = np.roll(histogram, 1, 1), np.roll(histogram, -1, 1)
    strong = histogram >= STRONG_SHARE * histogram.max(1, keepdims=True, initial=0)
    point, number = np.nonzero((histogram > before) & (histogram >= after) & strong)
    low, middle, high = (each[point, number] for each in (before, histogram, after))
    # The top of a parabola through three bins.
    exact = number + 0.5 + (low - high) / (2 * np.minimum(low - 2 * middle + high, -1e-12))
    return point, exact * (2 * math.pi / BINS)


def _cell_shares() -> Picture:
    """Returns the share of every sample in every cell, less at the border, `[samples, cells]`."""
    middles = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    along = np.clip(1 - np.abs(_ALONG[:, None] - middles) * CELLS / 2, 0, None)
    shares = np.einsum("yr,xc->yxrc", along, along).reshape(SIDE**2, CELLS**2)
    return (shares * np.exp(-(np.abs(_SQUARE) ** 2) / 2)[:, None]).astype(np.float32)


_SHARES = _cell_shares()


def _descriptors(turned: Complex) -> Picture:
    """Describes points by the slopes in the cells of their squares."""
    right, down = turned.real.astype(np.float32), turned.imag.astype(np.float32)
    strength = np.maximum(right**2 + down**2, 1e-12)
    values = np.empty((len(turned), CELLS**2, HEADINGS), np.float32)
    for number in range(HEADINGS):
        heading = 2 * math.pi * number / HEADINGS
        towards = np.maximum(right * math.cos(heading) + down * math.sin(heading), 0)
        # A slope counts by the cube of the cosine: mostly for the two nearest headings.
        values[..., number] = (towards * towards * towards / strength) @ _SHARES
    vectors = values.reshape(len(turned), CELLS**2 * HEADINGS)
    vectors = vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12)
    vectors = np.minimum(vectors, LARGEST_VALUE)
    return np.sqrt(vectors / (vectors.sum(1, keepdims=True) + 1e-12))
