"""Recognises photographs that show the same ground, by points and by their whole overlap."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.cluster.hierarchy import DisjointSet

from skyproof.imagery.tiles.georeference import DEGREES, distances_m
from skyproof.imagery.tiles.keypoints import Complex, Keypoints, Numbers, find_keypoints

MOST_KEYPOINTS = 256
"""Points of a photograph; some count twice, with two headings."""
CLEARLY_NEARER = 0.8
"""Share of the distance to the second nearest point at which the nearest is a match."""
MOST_MATCHES = 60
LEAST_MATCHES = 6
TOLERANCE_PX = 2.5
LEAST_BASE_PX = 25.0
"""Distance of two matches that suggest how photographs lie to each other."""
LARGEST_SCALE = 2.0
LARGEST_TURN_RAD, LARGEST_GROWTH = 0.5, 0.6
"""Largest differences of a match from a suggested turn: in radians, and in the log of scale."""
LEAST_CORRELATION = 0.4
MOST_ELSEWHERE = 0.85
"""Share of the correlation that the overlap may reach at any other shift.

Bays of a car park, tiles of a roof and furrows of a field reach nearly all of it.
"""
ELSEWHERE_PX = 4
LEAST_OVERLAP = 0.1
ENOUGH_PAIRS = 4
"""Number of pairs of a photograph beyond which redundant pairs are left out."""
MOST_NEIGHBOURS = 250
"""A photograph is compared with this many before and after it, so that time grows only linearly.

Photographs of a flight are neighbours in the order of their names.
"""

OBLIQUE_M = 200.0
"""Largest horizontal distance of a camera from the ground it shows, with its receiver's error."""

_AT_ONCE = 32


@dataclass(frozen=True)
class CoarseView:
    """A photograph at a coarse scale, and its points.

    Attributes:
        details: brightness less that of the surroundings, `[H, W]`, 0 where not usable.
        usable: pixels with data and without labelled vehicles, `[H, W]`.
        pixel_m: metres per pixel.
        stood: longitude and latitude of the camera in degrees, if it is known.
    """

    details: NDArray[np.float32]
    usable: NDArray[np.bool_]
    pixel_m: float
    keypoints: Keypoints
    stood: tuple[float, float] | None = None

    @classmethod
    def of(
        cls, grey: NDArray[np.float32], usable: NDArray[np.bool_], pixel_m: float
    ) -> "CoarseView":
        details = ndimage.gaussian_filter(grey, 0.6) - ndimage.gaussian_filter(grey, 3.8)
        # Otherwise the strong edges of a few things would outweigh everything else.
        spread = details[usable].std() if usable.any() else 1.0
        details = np.clip(details / max(spread, 1e-6), -2.5, 2.5) * usable
        keypoints = find_keypoints(grey, usable, MOST_KEYPOINTS)
        return cls(details.astype(np.float32), usable, pixel_m, keypoints)

    @property
    def area_m2(self) -> float:
        return self.usable.size * self.pixel_m**2


@dataclass(frozen=True)
class PhotographPair:
    """Two photographs, by number, that show the same ground.

    Places are metres from the top-left corner, x right and y down, as complex numbers. A place z of
    the second is `turn` z + `shift` in the first; `places` are two of them, amid those compared.
    """

    first: int
    second: int
    turn: complex
    shift: complex
    places: tuple[complex, complex]


def find_pairs(
    views: Sequence[CoarseView], progress: Callable[[int, int], None] = lambda *_: None
) -> list[PhotographPair]:
    """Finds pairs that show the same ground: enough to join all that do, and to check each other.

    Those with most matches come first. `progress` gets (photographs done, all).
    """
    joined = DisjointSet(range(len(views)))
    degree = [0] * len(views)
    found: list[PhotographPair] = []
    matched = sorted(_matches(views, progress), key=lambda each: -len(each[2]))
    for first, second, points, partners in matched:
        enough = min(degree[first], degree[second]) >= ENOUGH_PAIRS
        if enough and joined.connected(first, second):
            continue
        if _far_apart(views[first], views[second]):
            continue
        pair = _compared(views, first, second, points, partners)
        if pair is not None:
            found.append(pair)
            degree[first] += 1
            degree[second] += 1
            joined.merge(first, second)
    return found


def _far_apart(one: CoarseView, other: CoarseView) -> bool:
    """Returns whether the cameras stood too far apart to see the same ground."""
    if one.stood is None or other.stood is None:
        return False
    (apart_m,) = distances_m(DEGREES, [one.stood, other.stood]) or [0.0]
    diagonals_m = sum(math.hypot(*view.usable.shape) * view.pixel_m for view in (one, other))
    return apart_m > OBLIQUE_M + diagonals_m


def _matches(
    views: Sequence[CoarseView], progress: Callable[[int, int], None]
) -> Iterator[tuple[int, int, Numbers, Numbers]]:
    """Yields two photographs and their points that look alike, by number, the clearest first.

    Each of two points has to be the nearest of the other, and clearly so.
    """
    # Descriptors of all, with zeros after the last of each.
    most = max([2, *(len(view.keypoints.places) for view in views)])
    descriptors = torch.zeros(len(views), most, views[0].keypoints.descriptors.shape[1])
    for number, view in enumerate(views):
        own = torch.from_numpy(view.keypoints.descriptors)
        descriptors[number, : len(own)] = own
    for first in range(len(views)):
        last = min(len(views), first + 1 + MOST_NEIGHBOURS)
        for start in range(first + 1, last, _AT_ONCE):
            others = descriptors[start : min(start + _AT_ONCE, last)]
            # [photographs, points, points]
            alike = descriptors[first] @ others.transpose(1, 2)
            nearest = alike.topk(2, dim=2)
            best, second_best = nearest.values.unbind(2)
            partner = nearest.indices[..., 0]
            # Squares of distances of unit vectors.
            ratio = (1 - best) / (1 - second_best).clamp(min=1e-6)
            matched = (alike.amax(1).gather(1, partner) == best) & (best > 0)
            matched &= ratio < CLEARLY_NEARER**2
            for number in (matched.sum(1) >= LEAST_MATCHES).nonzero()[:, 0].tolist():
                points = matched[number].nonzero()[:, 0]
                points = points[ratio[number, points].argsort(stable=True)[:MOST_MATCHES]]
                partners = partner[number, points]
                yield first, start + number, points.numpy(), partners.numpy()
        progress(first + 1, len(views))


def _compared(
    views: Sequence[CoarseView], first: int, second: int, points: Numbers, partners: Numbers
) -> PhotographPair | None:
    one, two = views[first], views[second]
    found = _similarity(one, two, points, partners)
    if found is None:
        return None
    turn, shift, agreeing = found
    if not _overlap_agrees(one, two, turn, shift):
        return None
    places = agreeing * two.pixel_m
    middle, reach = places.mean(), places.std()
    ends = complex(middle - reach), complex(middle + reach)
    return PhotographPair(first, second, turn, shift, ends)


def _similarity(
    one: CoarseView, two: CoarseView, points: Numbers, partners: Numbers
) -> tuple[complex, complex, Complex] | None:
    """Finds the turn and shift from `two` to `one` that most matches support.

    Every pair of matches suggests one. Returns them in metres, and the places in `two` of the
    matches that agree.
    """
    here, there = one.keypoints, two.keypoints
    to = here.places[points] * one.pixel_m
    places_px = there.places[partners]
    off = places_px * two.pixel_m
    sizes = here.sizes[points] * one.pixel_m / (there.sizes[partners] * two.pixel_m)
    tolerance_m = TOLERANCE_PX * one.pixel_m

    def turned_alike(sizes: Complex, turns: Complex) -> NDArray[np.bool_]:
        relative = np.log(sizes / turns)
        grown = np.abs(relative.real) < LARGEST_GROWTH
        return grown & (np.abs(relative.imag) < LARGEST_TURN_RAD)

    def agree(turns: Complex, shifts: Complex) -> NDArray[np.bool_]:
        """Returns which matches agree with turns and shifts, `[..., matches]`."""
        near = np.abs(turns[..., None] * off + shifts[..., None] - to) < tolerance_m
        return near & turned_alike(sizes, turns[..., None])

    one_end, other_end = np.triu_indices(len(points), 1)
    base = off[one_end] - off[other_end]
    turns = (to[one_end] - to[other_end]) / np.where(base == 0, 1, base)
    likely = (np.abs(base) > LEAST_BASE_PX * two.pixel_m) & (turns != 0)
    likely &= (np.abs(turns) < LARGEST_SCALE) & (np.abs(turns) > 1 / LARGEST_SCALE)
    for end in (one_end, other_end):
        likely[likely] &= turned_alike(sizes[end[likely]], turns[likely])
    turns, one_end = turns[likely], one_end[likely]
    if not len(turns):
        return None
    shifts = to[one_end] - turns * off[one_end]
    agreeing = agree(turns, shifts)
    best = int(agreeing.sum(1).argmax())
    inside = agreeing[best]
    for _ in range(4):
        # A point may have matches with two headings.
        if len(np.unique(places_px[inside])) < LEAST_MATCHES:
            return None
        columns = np.stack([off[inside], np.ones(inside.sum())], 1)
        turn, shift = np.linalg.lstsq(columns, to[inside], rcond=None)[0]
        before, inside = inside, agree(turn, shift)
        if (before == inside).all():
            break
    return complex(turn), complex(shift), places_px[before]


def _overlap_agrees(one: CoarseView, two: CoarseView, turn: complex, shift: complex) -> bool:
    """Returns whether the overlap of two views correlates, and at other shifts much less."""
    step = one.pixel_m / (turn * two.pixel_m)
    # Pixels have their places at their middles.
    start = step * (0.5 + 0.5j) - shift / (turn * two.pixel_m) - (0.5 + 0.5j)
    matrix = np.array([[step.real, step.imag], [-step.imag, step.real]])
    details, usable = (
        ndimage.affine_transform(
            values, matrix, (start.imag, start.real), output_shape=one.usable.shape, order=1
        )
        for values in (two.details, two.usable.astype(np.float32))
    )
    both = one.usable & (usable > 0.99)
    smaller_m2 = min(one.area_m2, two.area_m2 * abs(turn) ** 2)
    if both.sum() * one.pixel_m**2 < LEAST_OVERLAP * smaller_m2:
        return False
    parts = [np.where(both, part - part[both].mean(), 0) for part in (one.details, details)]
    size = [fft.next_fast_len(side * 3 // 2, real=True) for side in both.shape]
    spectra = [fft.rfft2(part, size) for part in parts]
    correlation = fft.irfft2(spectra[0] * spectra[1].conj(), size)
    correlation /= max(np.prod([np.linalg.norm(part) for part in parts]), 1e-12)
    rows, columns = (np.abs(fft.fftfreq(side, 1 / side)) for side in size)
    distance_px = np.hypot(rows[:, None], columns)
    here = correlation[distance_px <= 2].max()
    elsewhere = correlation[distance_px > ELSEWHERE_PX].max()
    return here >= LEAST_CORRELATION and elsewhere <= MOST_ELSEWHERE * here
