"""Finds drivable ground on imagery by a simple rule, and the heading of vehicles there."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch.nn.functional as F
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.datasets.pictures import Boxes, Pixels, window_around
from skyproof.scenes.directions import direction_values, with_room
from skyproof.scenes.places import RemovedVehicle

_Grid = NDArray[np.floating[Any]]
_Mask = NDArray[np.bool_]

CELL_M = 0.375
"""The rule works on cells of about this size, so that it is fast and ignores noise."""
LINES_M = 1.75
"""Brighter marks narrower than half of this count as paint on the ground."""
ROUGHNESS = 0.03
STEP_PER_CELL = 0.06
"""Plain ground has no larger dark deviation, as a share of the brightness, and no larger step."""
LARGEST_SATURATION = 0.2
LARGEST_GREENNESS = 0.03
DARKEST, BRIGHTEST = 0.15, 0.85
"""Asphalt and concrete, in sRGB from 0 to 1: grey, and neither shadow nor white roof."""
CHROMA_NEAR = 0.03
BRIGHTNESS_NEAR = 0.35
"""Largest differences to ground beside a vehicle, in shares of red, green and blue, and in
brightness as a share."""
BESIDE_M = (0.4, 1.5)
TOUCHING_M = 1.5
DIRECTION_WITHIN_M = 3.0
"""Standard deviation of the Gaussian that weights edges for the direction."""
LEAST_AGREEMENT = 0.35
"""From 0 (edges in all directions) to 1: below it, half of the directions were off by over 10°."""
ALONGSIDE_M = 6.0
"""Vehicles this close stand alike: 98 % are within 10°, but 82 % up to 8 m, and half beyond."""


def drivable_directions(
    image: Pixels, gsd_m: float, vehicles: Boxes | None = None, stood: Sequence[RemovedVehicle] = ()
) -> UInt8[np.ndarray, "H W"]:
    """Returns a tile's map of drivable ground (`skyproof.scenes.directions`), found in its picture.

    Drivable ground is plain (without dark texture or steps, except painted lines) and wide enough.
    Without labels (None) it is also grey. With boxes of labelled vehicles it has the colour of the
    ground beside one of them, and is connected to one. The heading is that of a vehicle that stood
    within 6 m, or else the direction of least change by the structure tensor of the picture. Ground
    without a sure heading is left out. Limits: docs/imagery.md.
    """
    cell_px = max(1, round(CELL_M / gsd_m))
    cell_m = cell_px * gsd_m
    result = np.zeros(tuple(image.shape[1:]), np.uint8)
    if min(image.shape[1:]) < 3 * cell_px or (vehicles is not None and not len(vehicles)):
        return result
    averaged = F.avg_pool2d(image.float(), cell_px) / 255
    cells = averaged.permute(1, 2, 0).double().contiguous().numpy()
    grey = _mean(cells)
    colour = ndimage.uniform_filter(cells, (3, 3, 0))
    plain = _plain(grey, cell_m)
    boxes = np.zeros((0, 4)) if vehicles is None else vehicles.double().numpy() / cell_px
    like = _grey(colour) if vehicles is None else _like_beside(colour, plain, boxes, cell_m)
    # Specks are removed and pinholes filled.
    opened = ndimage.binary_opening(plain & like)
    free: _Mask = ndimage.binary_closing(opened) | opened
    if vehicles is not None:
        # The connected areas that reach to a vehicle.
        beside = free & _around(free.shape, boxes, TOUCHING_M / cell_m)
        free = ndimage.binary_propagation(beside, mask=free)
    heading_rad, sure = _heading_rad(grey, cell_m)
    heading_rad, sure = _alongside(heading_rad, sure, stood, cell_px, cell_m)
    directions = np.where(free & sure, direction_values(heading_rad), 0).astype(np.uint8)
    directions = with_room(directions, free, cell_m)
    fine = np.repeat(np.repeat(directions, cell_px, 0), cell_px, 1)
    result[: fine.shape[0], : fine.shape[1]] = fine
    return result


def _plain(grey: _Grid, cell_m: float) -> _Mask:
    """Masks ground without dark texture and without steps, except brighter lines."""
    # Medians along rows and then along columns cost a fifth of one over squares.
    width = max(3, round(LINES_M / cell_m))
    without_lines = ndimage.median_filter(ndimage.median_filter(grey, (1, width)), (width, 1))
    dark = ndimage.uniform_filter(np.maximum(without_lines - grey, 0), max(3, round(1.25 / cell_m)))
    step = ndimage.gaussian_gradient_magnitude(without_lines, 0.25 / cell_m)
    paint = ndimage.uniform_filter((grey > without_lines + 0.25).astype(np.float32), 3)
    plain: _Mask = (dark < ROUGHNESS * without_lines) & (step < STEP_PER_CELL) & (paint < 0.7)
    return plain


def _mean(colour: _Grid) -> _Grid:
    # Over the last axis, of length three, NumPy's own mean is slow.
    return (colour[..., 0] + colour[..., 1] + colour[..., 2]) / 3


def _grey(colour: _Grid) -> _Mask:
    brightness = _mean(colour)
    red, green, blue = np.moveaxis(colour, 2, 0)
    highest, lowest = colour.max(2), colour.min(2)
    grey: _Mask = highest - lowest < LARGEST_SATURATION * highest
    grey &= green - (red + blue) / 2 < LARGEST_GREENNESS
    return grey & (brightness > DARKEST) & (brightness < BRIGHTEST)


def _like_beside(colour: _Grid, plain: _Mask, boxes: _Grid, cell_m: float) -> _Mask:
    """Masks ground that looks like the plain ground beside at least one vehicle."""
    brightness = np.maximum(_mean(colour), 1e-3)
    chroma = colour / (3 * brightness[..., None])
    free = plain & ~_around(plain.shape, boxes, BESIDE_M[0] / cell_m)
    seen = []
    for box in boxes:
        near = window_around(box.tolist(), BESIDE_M[1] / cell_m, plain.shape)
        if free[near].any():
            shares = np.median(chroma[near][free[near]], 0)
            level = np.median(brightness[near][free[near]])
            seen.append([*np.round(shares, 2), round(float(level), 2)])
    like = np.zeros_like(plain)
    # Many vehicles stand on ground of few colours.
    for *shares, level in np.unique(np.array(seen).reshape(-1, 4), axis=0):
        alike = np.all(np.abs(chroma - np.array(shares)) < CHROMA_NEAR, axis=2)
        like |= alike & (np.abs(brightness - level) < BRIGHTNESS_NEAR * level)
    return like


def _around(size: tuple[int, ...], boxes: _Grid, margin: float) -> _Mask:
    """Masks boxes grown by a margin, all in cells."""
    mask = np.zeros(size, dtype=bool)
    for box in boxes.tolist():
        mask[window_around(box, margin, size)] = True
    return mask


def _alongside(
    heading_rad: _Grid, sure: _Mask, stood: Sequence[RemovedVehicle], cell_px: int, cell_m: float
) -> tuple[_Grid, _Mask]:
    """Sets the heading of cells near vehicles to that of the nearest vehicle."""
    rows, columns = np.indices(sure.shape) + 0.5
    nearest_m = np.full(sure.shape, ALONGSIDE_M)
    for one in stood:
        if one.heading_rad is not None:
            away = np.hypot(columns - one.x_px / cell_px, rows - one.y_px / cell_px)
            near = away * cell_m < nearest_m
            nearest_m = np.where(near, away * cell_m, nearest_m)
            heading_rad = np.where(near, one.heading_rad, heading_rad)
    return heading_rad, sure | (nearest_m < ALONGSIDE_M)


def _heading_rad(grey: _Grid, cell_m: float) -> tuple[_Grid, _Mask]:
    """Returns the direction of least change around each cell, and whether edges agree on it.

    The direction runs from x (right) towards up.
    """
    right = ndimage.gaussian_filter(grey, 1, order=(0, 1))
    down = ndimage.gaussian_filter(grey, 1, order=(1, 0))
    # Weak edges count in proportion to their strength, and strong ones almost equally, so that a
    # tree's rim does not outweigh the kerb.
    strength = np.hypot(right, down)
    weight = 1 / ((strength + 1e-6) * (1 + 50 * strength))
    reach = DIRECTION_WITHIN_M / cell_m
    difference, product, whole = (
        ndimage.gaussian_filter(each * weight, reach, truncate=3)
        for each in (right * right - down * down, 2 * right * down, right * right + down * down)
    )
    across_rad = 0.5 * np.arctan2(product, difference)
    # Rows run down, and the heading is at right angles to the change.
    sure: _Mask = np.hypot(difference, product) >= LEAST_AGREEMENT * whole
    return -(across_rad + math.pi / 2), sure
