"""Which windows are learnt from and which are tested, and how sure an AUC is, for realism.py.

Photographs of one place repeat the parked vehicles, and rendered vehicles come from one fleet.
What is tested therefore lies on other ground than what was learnt from, with a gap between, and
shows other vehicles of the fleet. A real vehicle that drives from one part of the place to another
is not recognised as the same.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from skyproof.results.statistics.intervals import Interval, bootstrap_interval, resample

if TYPE_CHECKING:
    from realism_crops import Crop

SAME_SPOT_M = 1.5
"""Vehicles this close together on the same ground count as one in the bootstrap."""

_PEAK = 15.0  # of the correlation, in its standard deviations: chance alone reaches about 5


@dataclass(frozen=True)
class Drift:
    """Where a photograph lies.

    Attributes:
        ground: names the ground it shows; positions on one ground can be compared.
        shift_px: what is to be added to its pixels, right and down, for the ground's.
    """

    ground: str
    shift_px: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Fold:
    """One split of the windows.

    Attributes:
        name: what is tested.
        train, test: `[N]` whether a window is learnt from, or tested.
    """

    name: str
    train: NDArray[np.bool_]
    test: NDArray[np.bool_]


def drift_of_sources(place: str, grey: dict[str, NDArray[np.float32]]) -> dict[str, Drift]:
    """Finds how far photographs of one place are shifted, by phase correlation with the first.

    A photograph in which the ground of the first cannot be found counts as ground of its own.

    Args:
        place: names the ground of the first.
        grey: per source a picture `[H, W]`.
    """
    names = list(grey)
    found = {names[0]: Drift(place, (0.0, 0.0))}
    for name in names[1:]:
        x, y, peak = _shift(grey[names[0]], grey[name])
        known = peak >= _PEAK
        found[name] = Drift(place, (x, y)) if known else Drift(f"{place}/{name}", (0.0, 0.0))
    return found


def _shift(first: NDArray[np.float32], second: NDArray[np.float32]) -> tuple[float, float, float]:
    """Returns what is to be added to places in the second for the first's, and how clear it is."""
    # Averaged over squares of two, which hides the blocks of JPEG and a car's shift of a pixel.
    height, width = (min(a, b) // 2 for a, b in zip(first.shape, second.shape, strict=True))
    spectra = []
    for picture in (first, second):
        small = picture[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean((1, 3))
        taper = np.outer(np.hanning(height), np.hanning(width))
        spectra.append(fft.rfft2((small - small.mean()) * taper))
    cross = spectra[0] * np.conj(spectra[1])
    surface = fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), (height, width))
    y, x = np.unravel_index(int(surface.argmax()), surface.shape)
    right = x - width if x > width // 2 else x
    down = y - height if y > height // 2 else y
    return 2.0 * float(right), 2.0 * float(down), float(surface.max() / surface.std())


def strip_folds(crops: Sequence[Crop], count: int, gap_m: float) -> list[Fold]:
    """Cuts every place into strips with as many real windows each, and tests one after another.

    Args:
        crops: the windows.
        count: how many strips.
        gap_m: windows nearer than this to the tested strip are not learnt from.
    """
    rendered = np.array([crop.rendered for crop in crops])
    positions = np.array([crop.position_m for crop in crops])
    grounds = np.array([crop.ground for crop in crops])
    train = np.zeros((count, len(crops)), dtype=bool)
    test = np.zeros((count, len(crops)), dtype=bool)
    for ground in np.unique(grounds):
        own = grounds == ground
        deciding = positions[own & ~rendered] if (own & ~rendered).any() else positions[own]
        axis = int(np.ptp(deciding, axis=0).argmax())
        cuts = np.quantile(deciding[:, axis], np.arange(1, count) / count)
        edges = [-np.inf, *cuts, np.inf]
        along = positions[:, axis]
        for number in range(count):
            low, high = edges[number : number + 2]
            test[number] |= own & (along >= low) & (along < high)
            train[number] |= own & ((along < low - gap_m) | (along >= high + gap_m))
    names = [f"strip {number + 1} of {count}" for number in range(count)]
    return _with_other_vehicles(crops, names, train, test)


def place_folds(crops: Sequence[Crop]) -> list[Fold]:
    """Tests one place after another, and learns from the others; nothing where there is but one."""
    places = list(dict.fromkeys(crop.place for crop in crops))
    if len(places) < 2:
        return []
    test = np.array([[crop.place == place for crop in crops] for place in places])
    return _with_other_vehicles(crops, places, ~test, test)


def _with_other_vehicles(
    crops: Sequence[Crop],
    names: Sequence[str],
    train: NDArray[np.bool_],
    test: NDArray[np.bool_],
) -> list[Fold]:
    """Leaves in each fold only vehicles of the fleet that are on the right side of it."""
    count = len(names)
    turn = np.array(
        [zlib.crc32(crop.vehicle.encode()) % count if crop.vehicle else -1 for crop in crops]
    )
    return [
        Fold(
            name,
            train[number] & (turn != number),
            test[number] & ((turn == number) | (turn == -1)),
        )
        for number, name in enumerate(names)
    ]


def spots(crops: Sequence[Crop]) -> NDArray[np.int64]:
    """Numbers the spots that windows show: one vehicle in several photographs is on one.

    Returns:
        `[N]` each window's spot; a real and a rendered window are never on the same.
    """
    centres: dict[tuple[str, bool], list[tuple[float, float, int]]] = {}
    numbers = np.zeros(len(crops), dtype=np.int64)
    count = 0
    for index, crop in enumerate(crops):
        known = centres.setdefault((crop.ground, crop.rendered), [])
        x, y = crop.position_m
        near = [
            number
            for spot_x, spot_y, number in known
            if (spot_x - x) ** 2 + (spot_y - y) ** 2 <= SAME_SPOT_M**2
        ]
        if not near:
            known.append((x, y, count))
            near = [count]
            count += 1
        numbers[index] = near[0]
    return numbers


def auc_interval(
    scores: NDArray[np.float64],
    positive: NDArray[np.bool_],
    folds: NDArray[np.int64],
    clusters: NDArray[np.int64],
    *,
    generator: np.random.Generator,
) -> Interval:
    """Gives the area under the ROC curve, the mean over repeats, with its 95 % interval.

    It is the share of pairs of a positive and a negative window in which the positive one scores
    higher; ties count half. Only windows tested in one fold, so by one network, are compared. A
    cluster of many windows weighs no more than one of a single window. The bootstrap draws
    clusters, positive and negative ones apart. nan where no pair can be compared.

    Args:
        scores: `[K, N]` per repeat and window.
        positive: `[N]` which windows should score higher.
        folds: `[N]` in which fold a window was tested; negative where in none.
        clusters: `[N]` windows of one number are drawn together.
        generator: of the bootstrap.
    """
    sides = [np.flatnonzero(wanted & (folds >= 0)) for wanted in (positive, ~positive)]
    higher, lower = sides
    together = (folds[higher][:, None] == folds[lower][None]).astype(np.float64)
    difference = scores[:, higher, None] - scores[:, None, lower]
    won = ((np.sign(difference) + 1) / 2).mean(0) * together
    if not together.any():
        return Interval(float("nan"), float("nan"), float("nan"))
    # With means over clusters, every replicate is two products of small matrices.
    belongs = []
    for side in sides:
        member = (np.unique(clusters[side])[:, None] == clusters[side][None]).astype(np.float64)
        belongs.append(member / member.sum(1, keepdims=True))
    won = belongs[0] @ won @ belongs[1].T
    pairs = belongs[0] @ together @ belongs[1].T

    def area(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        compared = ((first @ pairs) * second).sum(1)
        hits = ((first @ won) * second).sum(1)
        share = np.full_like(hits, np.nan)
        return np.divide(hits, compared, out=share, where=compared > 0)

    counts = [len(side) for side in belongs]
    drawn = [resample(count, generator=generator).astype(np.float64) for count in counts]
    ones = [np.ones((1, count)) for count in counts]
    left_out = [1 - np.eye(count) for count in counts]
    without = [
        area(left_out[0], np.repeat(ones[1], counts[0], 0)),
        area(np.repeat(ones[0], counts[1], 0), left_out[1]),
    ]
    estimate = float(area(ones[0], ones[1])[0])
    return bootstrap_interval(estimate, area(*drawn), np.concatenate(without), (0.0, 1.0))
