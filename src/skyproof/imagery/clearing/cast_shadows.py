"""Finds the shadows that trees and buildings cast in photographs, and how much light they leave."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch.nn.functional as F
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from skyproof.geometry.colour import srgb_to_linear
from skyproof.scenes.light import Light, SunEstimate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_M = 0.25
"""The rule looks at cells of about this size, so that it costs little and sees no noise."""
DARKEST = 2e-3
LIT_PERCENTILE, LIT_WITHIN_M = 0.6, 10.5
"""The lit ground is as bright as this part of what is not green within such a distance."""
LEVELS = (0.35, 0.55, 0.75, 0.95, 1.15, 1.35, 1.6, 1.9, 2.2)
"""How much darker than it areas are looked for; like all brightness here, in natural logarithms."""
GREENNESS = 0.12
"""Plants, by green against the geometric mean of red and blue: none of them is looked at."""
OPENED_M, SMALLEST_M2 = 0.5, 5.0

RING_M = (0.4, 1.4)
"""Ground on both sides of an edge lies so far from it, beyond the sensor's blur."""
LEAST_DARKER, MOST_DARKER = 0.5, 2.5
LEAST_BLUER = 0.18
FAINT = 0.25
FAR_SIDE, SUN_SIDE = 0.3, -0.3
"""An edge is on the far side of an area, or on the side of the sun, where the cosine of the angle
between the way out of the area and the way shadows fall is above the first, or below the second."""
SHADOW_SHARE, FAINT_SHARE = 0.75, 0.15
SUN_SIDE_SHARE, ALIKE = 0.3, 0.4
SHORTEST_EDGE_M = 2.5

FEWEST_EDGE_M = 10.0
"""So much edge tells how much light is left; with less the photograph says nothing."""
LIKE_OTHERS = 0.4
PENUMBRA_M = 0.25


@dataclass(frozen=True)
class CastShadow:
    """An area in shadow.

    Attributes:
        inside: `[rows, columns]` cells of the picture, as many pixels wide as `cell_px`.
        ratios: `[e, 3]`, red, green and blue in the shadow as natural logarithms of parts of those
            of the lit ground beside it, for each cell along its far edge.
        cell_px: side of a cell.
    """

    inside: Mask
    ratios: Array
    cell_px: int
    cell_m: float


def find_cast_shadows(
    image: UInt8[Tensor, "3 H W"], light: Light, sun: SunEstimate, *, gsd_m: float
) -> list[CastShadow]:
    """Finds areas in cast shadow on ground that is not green.

    All is compared in linear light, less the photograph's black. An area darker than the lit ground
    around it is in shadow where

    - on its far side, seen from the sun, at least three quarters of its edge are an edge of a
      shadow: by 0.5 to 2.5 (natural logarithm) darker than the ground outside, and bluer by 0.18,
      because the sky alone lights it;
    - towards the sun it borders on something else, namely what casts it: less than 0.3 times as
      much of its edge there is alike, or ground of another colour lies outside. Streets between
      pavements are dark and may be bluer, but on both sides;
    - hardly anywhere (15 %) is the edge faint, as where a level cuts through ground of one kind.

    Areas are looked for at nine levels. Where they overlap, the one with more such edge counts.

    Limits: shaded lawns are not found, and neither are shadows with hardly any light outside them
    (in narrow streets) or under a bright overcast sky, which is not bluer.

    Returns:
        Areas that do not overlap, those with most edge first.
    """
    cell_px = max(1, round(CELL_M / gsd_m))
    cell_m = cell_px * gsd_m
    if min(image.shape[1:]) * gsd_m < 2 * RING_M[1]:
        return []
    cells = _cells(image, light, cell_px)
    smooth = ndimage.gaussian_filter(cells, (0, CELL_M / cell_m, CELL_M / cell_m))
    brightness = np.log(smooth.mean(0))
    ground = np.log(smooth[1] / np.sqrt(smooth[0] * smooth[2])) < GREENNESS
    lit = _lit_level(brightness, ground, cell_m)
    # Rows run down, so shadows fall along (-cos, sin) there.
    fall = (-math.cos(sun.azimuth_rad), math.sin(sun.azimuth_rad))
    found: list[tuple[int, CastShadow]] = []
    for level in LEVELS:
        dark = ndimage.binary_opening(ground & (brightness < lit - level), _disk(OPENED_M / cell_m))
        for value, inside, ratios in _in_shadow(np.log(cells), dark, ground, fall, cell_m):
            found.append((value, CastShadow(inside, ratios, cell_px, cell_m)))
    found.sort(key=lambda each: -each[0])
    return [each for _, each in _apart(found)]


def light_left(shadows: Iterable[CastShadow]) -> tuple[float, float, float] | None:
    """Returns the part of the light that is left in shadows, the median along their edges.

    Returns:
        Red, green and blue; None where there is less than 10 m of edge.
    """
    known = list(shadows)
    if sum(len(each.ratios) * each.cell_m for each in known) < FEWEST_EDGE_M:
        return None
    red, green, blue = np.exp(np.median(np.concatenate([each.ratios for each in known]), axis=0))
    return float(red), float(green), float(blue)


def shade_map(
    shadows: Iterable[CastShadow],
    left: tuple[float, float, float],
    size_px: tuple[int, int],
    *,
    gsd_m: float,
) -> UInt8[np.ndarray, "H W"]:
    """Draws a tile's map of shadows, as `BackgroundTile.shade` says, with soft edges.

    Areas that are much darker or brighter than the picture's other shadows (by 0.4, natural
    logarithm) are left out: they are of another material.

    Args:
        left: what `light_left` says of the whole picture.
    """
    shade = np.zeros(size_px)
    for each in shadows:
        if np.abs(np.median(each.ratios, axis=0) - np.log(left)).max() > LIKE_OTHERS:
            continue
        fine = np.repeat(np.repeat(each.inside, each.cell_px, 0), each.cell_px, 1)
        shade[: fine.shape[0], : fine.shape[1]][fine] = 255
    return np.round(ndimage.gaussian_filter(shade, PENUMBRA_M / gsd_m)).astype(np.uint8)


def _cells(image: UInt8[Tensor, "3 H W"], light: Light, cell_px: int) -> Array:
    """Averages the light over whole cells, `[3, rows, columns]`; nothing is quite black."""
    linear = srgb_to_linear(image.double() / 255)
    black = np.asarray(light.black)[:, None, None]
    averaged: Array = F.avg_pool2d(linear, cell_px).numpy() - black
    return np.maximum(averaged, DARKEST)


def _lit_level(brightness: Array, ground: Mask, cell_m: float) -> Array:
    """Returns the brightness of lit ground around each cell: a percentile, within some metres.

    Where there is hardly any ground around, it is that of the tile.
    """
    step = max(1, round(1 / cell_m))
    rows, columns = (math.ceil(side / step) * step for side in brightness.shape)
    padding = [(0, rows - brightness.shape[0]), (0, columns - brightness.shape[1])]
    within = 2 * round(LIT_WITHIN_M / (step * cell_m)) + 1
    values = np.pad(brightness, padding, mode="edge")

    def around(chosen: Mask) -> tuple[Array, int]:
        counted = np.pad(chosen, padding).reshape(rows // step, step, columns // step, step)
        number = counted.sum((1, 3)).astype(np.float64)
        spread: Array = ndimage.uniform_filter(number, within, mode="constant")
        return spread, int(number.sum())

    total, in_all = around(ground)
    # Percentiles by counting at one brightness after the other, so that memory does not grow.
    lit = np.full(total.shape, np.log(DARKEST))
    of_tile = math.log(DARKEST)
    for value in np.arange(np.log(DARKEST), values.max() + 0.1, 0.1):
        darker, darker_in_all = around(ground & (brightness < value))
        lit[darker < LIT_PERCENTILE * total] = value + 0.05
        if darker_in_all < LIT_PERCENTILE * in_all:
            of_tile = value + 0.05
    # Less than a twentieth of the neighbourhood is too little.
    lit[total < 0.05 * step**2] = of_tile
    fine = np.repeat(np.repeat(lit, step, 0), step, 1)
    return fine[: brightness.shape[0], : brightness.shape[1]]


def _in_shadow(
    logarithms: Array, dark: Mask, ground: Mask, fall: tuple[float, float], cell_m: float
) -> Iterable[tuple[int, Mask, Array]]:
    """Tells which dark areas are in shadow: their score, their cells, and the ratios of edges."""
    areas, number = ndimage.label(dark)
    large = np.bincount(areas.ravel(), minlength=number + 1) * cell_m**2 >= SMALLEST_M2
    large[0] = False
    dark = large[areas]
    if not dark.any():
        return
    edge, inner, outer = _sides(logarithms, dark, ground, cell_m)
    own = areas[edge]
    ratios = inner - outer
    darker = -ratios.mean(0)
    bluer = ratios[2] - ratios[0]
    shadow = (darker > LEAST_DARKER) & (darker < MOST_DARKER) & (bluer > LEAST_BLUER)
    down, right = np.gradient(ndimage.gaussian_filter(dark.astype(np.float64), 2))
    # The way out of an area is where it becomes less.
    steepness = np.hypot(down, right)[edge] + 1e-9
    outwards = -(fall[0] * right[edge] + fall[1] * down[edge]) / steepness

    def counted(chosen: Mask) -> NDArray[np.int64]:
        return np.bincount(own[chosen], minlength=number + 1)

    far_side, sun_side = outwards > FAR_SIDE, outwards < SUN_SIDE
    on_far_side, good = counted(far_side), counted(far_side & shadow)
    likely = (
        large
        & (good * cell_m >= SHORTEST_EDGE_M)
        & (good >= SHADOW_SHARE * on_far_side)
        & (counted(darker < FAINT) <= FAINT_SHARE * counted(np.ones_like(far_side)))
    )
    sun_side_good = counted(sun_side & shadow)
    for area in np.nonzero(likely)[0]:
        far = (own == area) & far_side & shadow
        near = (own == area) & sun_side & shadow
        if sun_side_good[area] > SUN_SIDE_SHARE * good[area]:
            difference = np.median(outer[:, far], axis=1) - np.median(outer[:, near], axis=1)
            if np.abs(difference).max() < ALIKE:
                continue
        yield int(2 * good[area] - on_far_side[area]), areas == area, ratios[:, far].T


def _sides(logarithms: Array, dark: Mask, ground: Mask, cell_m: float) -> tuple[Mask, Array, Array]:
    """Returns the edge of dark areas, and for each of its cells the means on both sides.

    The mean is that of logarithms, `[3, e]`. Edges with too little ground on a side are left out.
    """
    depth_m = ndimage.distance_transform_edt(dark) * cell_m
    distance_m = ndimage.distance_transform_edt(~dark) * cell_m
    inside = (depth_m > RING_M[0]) & (depth_m < RING_M[1])
    outside = ground & (distance_m > RING_M[0]) & (distance_m < RING_M[1])
    size = 2 * round(1.25 / cell_m) + 1
    shares = [ndimage.uniform_filter(ring.astype(np.float64), size) for ring in (inside, outside)]
    edge = (depth_m > 0) & (depth_m < 1.01 * cell_m) & (shares[0] > 0.1) & (shares[1] > 0.1)
    means = [
        np.stack(
            [
                ndimage.uniform_filter(np.where(ring, channel, 0.0), size)[edge] / share[edge]
                for channel in logarithms
            ]
        )
        for ring, share in zip((inside, outside), shares, strict=True)
    ]
    return edge, means[0], means[1]


def _apart(found: Iterable[tuple[int, CastShadow]]) -> Iterable[tuple[int, CastShadow]]:
    """Leaves out areas that overlap earlier ones."""
    taken: Mask | None = None
    for value, each in found:
        if taken is None:
            taken = np.zeros_like(each.inside)
        if not (taken & each.inside).any():
            taken |= each.inside
            yield value, each


def _disk(radius: float) -> Mask:
    reach = max(1, math.floor(radius))
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk: Mask = np.hypot(down, right) <= reach + 0.3
    return disk
