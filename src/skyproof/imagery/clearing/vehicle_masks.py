"""Finds where vehicles and their shadows hide the ground, shadows in the pictures themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]

DIRECTIONS = 24
LONGEST_SHADOW_M = 6.0
LAYER_M = 0.25
NEAR_M = 1.0
SAMPLE_LIMIT = 300
FEWEST_VEHICLES = 3
FAINTEST_SHADOW = 0.05
"""Of the ground's brightness: the least by which the shadow side is darker than the side across."""
END_SHARE = 0.25
STRETCH, PENUMBRA_M = 1.25, 0.5
"""The shadow is taken longer than measured: vehicles higher than the median one, and soft edges."""


@dataclass(frozen=True)
class Shadow:
    """The shadow that vehicles of one picture cast on the ground.

    Attributes:
        direction: unit vector (x right, y down) it falls in; (0, 0) where vehicles cast no directed
            shadow.
        length_m: how far it reaches beyond a vehicle's box.
        contrast: how much darker the ground is on that side than on the other, as a part of its
            brightness.
        vehicles: how many it was measured on.
    """

    direction: tuple[float, float]
    length_m: float
    contrast: float
    vehicles: int


def vehicle_mask(
    size_px: tuple[int, int],
    boxes: Float[Tensor, "n 4"],
    shadow: Shadow | None,
    *,
    gsd_m: float,
    margin_m: float,
) -> Bool[Tensor, "H W"]:
    """Masks boxes grown by a margin and drawn along the shadow: all that the moving box touches.

    Args:
        boxes: pixel xyxy, half-open.
        shadow: as `estimate_shadow` found it; None where it is unknown: the margin is then doubled.
    """
    mask = np.zeros(size_px, dtype=bool)
    margin_px = margin_m / gsd_m * (1 if shadow is not None else 2)
    direction = shadow.direction if shadow is not None else (0.0, 0.0)
    length_px = shadow.length_m / gsd_m if shadow is not None else 0.0
    for left, top, right, bottom in boxes.tolist():
        grown = (left - margin_px, top - margin_px, right + margin_px, bottom + margin_px)
        rows, columns = window_around(grown, length_px + 1, size_px)
        if rows.stop > rows.start and columns.stop > columns.start:
            mask[rows, columns] |= arrival(grown, direction, rows, columns) <= length_px
    return torch.from_numpy(mask)


def darkness_profiles(
    image: UInt8[Tensor, "3 H W"],
    boxes: Float[Tensor, "n 4"],
    headings_rad: Sequence[float] | None = None,
    *,
    gsd_m: float,
) -> Float[Tensor, "n directions layers"]:
    """Measures how dark the ground beside each box is, by direction and by layer outwards.

    Where headings are given, each box is turned about its middle by its own, from x (right) towards
    up.

    A layer is what a box moved on by `LAYER_M` newly covers. Values are 1 - brightness / brightness
    of the ground around the vehicle (the median within 4 m), cut to [-0.5, 1]; nan where other
    boxes or the picture's edge leave nothing.
    """
    grey = image.double().mean(0).numpy()
    turns = [0.0] * len(boxes) if headings_rad is None else list(headings_rad)
    taken = covered_ground(boxes, turns, grey.shape)
    layers = round(LONGEST_SHADOW_M / LAYER_M)
    profiles = np.full((len(boxes), DIRECTIONS, layers), np.nan)
    for profile, box, turn_rad in zip(profiles, boxes.tolist(), turns, strict=True):
        rows, columns = window_around(box, LONGEST_SHADOW_M / gsd_m, grey.shape, turn_rad)
        free, values = ~taken[rows, columns], grey[rows, columns]
        near = window_around(box, 4 / gsd_m, grey.shape, turn_rad)
        around = grey[near][~taken[near]]
        if around.size < 50:
            continue
        ground = max(float(np.median(around)), 1.0)
        darkness = np.clip(1 - values / ground, -0.5, 1)
        for number in range(DIRECTIONS):
            arrival_m = arrival(box, _unit(number), rows, columns, turn_rad) * gsd_m
            counted = free & (arrival_m > 0) & (arrival_m < LONGEST_SHADOW_M)
            layer = (arrival_m[counted] / LAYER_M).astype(int)
            number_in = np.bincount(layer, minlength=layers)
            sums = np.bincount(layer, weights=darkness[counted], minlength=layers)
            profile[number] = np.where(number_in >= 3, sums / np.maximum(number_in, 1), np.nan)
    return torch.from_numpy(profiles).float()


def estimate_shadow(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> Shadow | None:
    """Estimates the shadow that all vehicles of one picture share.

    The direction is the sum of all directions weighted by how dark the ground is there within 1 m
    of the boxes (the median over vehicles). The length is where the darkness, less that of the side
    across, falls below a quarter of its largest value, stretched by a quarter and a soft edge for
    higher vehicles. What never ends within 6 m is not theirs, such as the trees they park under.

    Returns:
        None with fewer than 3 vehicles; without direction and length where no side is darker than
        the one across, as under an overcast sky.
    """
    stacked = stack_profiles(profiles)
    if len(stacked) < FEWEST_VEHICLES:
        return None
    (x, y), profile, contrast = shadow_side(stacked)
    length = math.hypot(x, y)
    peak = int(profile[: round(NEAR_M / LAYER_M)].argmax())
    ends = np.nonzero(profile[peak:] < END_SHARE * profile[peak])[0]
    # A darkness without an end is not the vehicles' own, but a road's dark side or the trees along
    # it.
    if contrast < FAINTEST_SHADOW or not len(ends):
        return Shadow((0.0, 0.0), 0.0, contrast, len(stacked))
    reach_m = STRETCH * (peak + int(ends[0])) * LAYER_M + PENUMBRA_M
    return Shadow(
        (float(x / length), float(y / length)),
        min(reach_m, LONGEST_SHADOW_M),
        contrast,
        len(stacked),
    )


def stack_profiles(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> Array:
    """Stacks the profiles of up to 300 vehicles with free ground, `[n, directions, layers]`."""
    measured = [
        darkness
        for tensor in profiles
        for darkness in tensor.double().numpy()
        if np.isfinite(darkness).any()
    ]
    return np.stack(measured[:SAMPLE_LIMIT]) if measured else np.zeros((0, DIRECTIONS, 1))


def shadow_side(stacked: Array, near_m: float = NEAR_M) -> tuple[tuple[float, float], Array, float]:
    """Finds the side of the boxes on which the ground is dark.

    Args:
        stacked: of one vehicle or more, as `stack_profiles` gives them.
        near_m: how far from the boxes ground is near.

    Returns:
        The way (x right, y down, of any length) that the sum of all directions, weighted by the
        darkness near the boxes, points; the darkness by layer on that side; and the darkness near
        the boxes there: both less those of the side across.
    """
    near_layers = round(near_m / LAYER_M)
    near = _median_of(stacked[:, :, :near_layers].reshape(len(stacked), -1))
    near = near.reshape(DIRECTIONS, -1).mean(1)
    units = np.array([_unit(number) for number in range(DIRECTIONS)])
    x, y = (near[:, None] * units).sum(0)
    best = round(math.atan2(y, x) / (2 * math.pi) * DIRECTIONS) % DIRECTIONS
    across = (best + DIRECTIONS // 2) % DIRECTIONS
    profile = _median_of(stacked[:, best]) - _median_of(stacked[:, across])
    return (float(x), float(y)), profile, float(near[best] - near[across])


def _median_of(values: Array) -> Array:
    """Takes the median over the first axis, without nan; 0 where there is nothing else."""
    masked = np.ma.masked_invalid(values)
    return np.ma.median(masked, axis=0).filled(0.0)


def _unit(number: int) -> tuple[float, float]:
    angle = 2 * math.pi * number / DIRECTIONS
    return math.cos(angle), math.sin(angle)


def covered_ground(
    boxes: Float[Tensor, "n 4"], headings_rad: Sequence[float], size_px: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Says per pixel of a picture of that height and width whether a turned box covers it."""
    covered = np.zeros(size_px, dtype=bool)
    for box, turn_rad in zip(boxes.tolist(), headings_rad, strict=True):
        rows, columns = window_around(box, 0.0, size_px, turn_rad)
        covered[rows, columns] |= arrival(box, (1.0, 0.0), rows, columns, turn_rad) == 0
    return covered


def window_around(
    box: Box | list[float], margin_px: float, size_px: tuple[int, ...], turn_rad: float = 0.0
) -> tuple[slice, slice]:
    """Returns the rows and columns around a box that is turned about its middle."""
    left, top, right, bottom = box
    cosine = abs(math.cos(turn_rad))
    sine = abs(math.sin(turn_rad))
    across = margin_px + ((right - left) * cosine + (bottom - top) * sine) / 2
    down = margin_px + ((right - left) * sine + (bottom - top) * cosine) / 2
    x, y = (left + right) / 2, (top + bottom) / 2
    return (
        slice(max(0, math.floor(y - down)), max(0, min(size_px[0], math.ceil(y + down)))),
        slice(max(0, math.floor(x - across)), max(0, min(size_px[1], math.ceil(x + across)))),
    )


def arrival(
    box: Box | list[float],
    direction: tuple[float, float],
    rows: slice,
    columns: slice,
    turn_rad: float = 0.0,
) -> Array:
    """Says per pixel centre how far the box must move in the direction until it covers it.

    It is 0 inside, and infinite where the box never comes. The box is turned about its middle.
    """
    left, top, right, bottom = box
    half = ((right - left) / 2, (bottom - top) / 2)
    x = np.arange(columns.start, columns.stop)[None, :] + 0.5 - (left + right) / 2
    y = np.arange(rows.start, rows.stop)[:, None] + 0.5 - (top + bottom) / 2
    # Rows run down, so the box's own axes are (cos, -sin) and (sin, cos).
    cosine = math.cos(turn_rad)
    sine = math.sin(turn_rad)
    first = np.zeros((rows.stop - rows.start, columns.stop - columns.start))
    last = np.full_like(first, np.inf)
    for places, reach, speed in (
        (cosine * x - sine * y, half[0], cosine * direction[0] - sine * direction[1]),
        (sine * x + cosine * y, half[1], sine * direction[0] + cosine * direction[1]),
    ):
        if abs(speed) < 1e-9:
            outside = abs(places) > reach
            first = np.where(outside, np.inf, first)
            last = np.where(outside, -np.inf, last)
            continue
        first_edge, second_edge = (places - reach) / speed, (places + reach) / speed
        first = np.maximum(first, np.minimum(first_edge, second_edge))
        last = np.minimum(last, np.maximum(first_edge, second_edge))
    return np.where(first <= last, first, np.inf)
