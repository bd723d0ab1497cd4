"""Finds the shadows of trees and buildings in photographs, and the light that they leave."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch.nn.functional as F
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.datasets.pictures import Pixels
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.clearing.sunlight import OVERCAST_SKY, by_picture, picture_of, sky_of
from skyproof.imagery.exposure import some_of
from skyproof.scenes.background_index import BackgroundTile, save_map
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_M = 0.25
"""The rule works on cells of about this size, so that it is fast and ignores noise."""
DARKEST = 2e-3
LIT_PERCENTILE, LIT_WITHIN_M = 0.6, 10.5
"""Lit ground is as bright as this percentile of the ground without plants, in this radius."""
LEVELS = (0.35, 0.55, 0.75, 0.95, 1.15, 1.35, 1.6, 1.9, 2.2)
"""Differences to lit ground at which areas are searched, in natural logarithms of brightness."""
GREENNESS = 0.12
"""Plants, which are skipped, have a larger logarithm of green over the mean of red and blue."""
OPENED_M, SMALLEST_M2 = 0.5, 5.0

RING_M = (0.4, 1.4)
"""Distances from an edge of the ground compared on its sides, beyond the sensor's blur."""
LEAST_DARKER, MOST_DARKER = 0.5, 2.5
LEAST_BLUER = 0.18
FAINT = 0.25
FAR_SIDE, SUN_SIDE = 0.3, -0.3
"""Limits of the cosine between the way out of an area and the fall of shadows: an edge above the
first is on the far side of the area, an edge below the second on the sun's side."""
SHADOW_SHARE, FAINT_SHARE = 0.75, 0.15
SUN_SIDE_SHARE, ALIKE = 0.3, 0.4
SHORTEST_EDGE_M = 2.5

FEWEST_EDGE_M = 10.0
"""Shortest edge, over a photograph, from which the light left in shadows is measured."""
LIKE_OTHERS = 0.4
PENUMBRA_M = 0.25


@dataclass(frozen=True)
class CastShadow:
    """An area in shadow.

    Attributes:
        inside: `[rows, columns]` cells of the picture.
        ratios: `[e, 3]` natural logarithm of red, green and blue in the shadow over those of the
            lit ground beside it, for each cell along its far edge.
        cell_px: side of a cell in pixels.
    """

    inside: Mask
    ratios: Array
    cell_px: int
    cell_m: float


def find_cast_shadows(
    image: Pixels, light: Light, sun: SunEstimate, *, gsd_m: float
) -> list[CastShadow]:
    """Finds areas in cast shadow on ground that is not green, those with most edge first.

    Colours are compared in linear light, less the photograph's black. An area darker than the lit
    ground around it is in shadow if

    - three quarters of its edge on the far side, seen from the sun, are an edge of a shadow:
      darker by 0.5 to 2.5 (natural logarithm) than the ground outside, and bluer by 0.18, because
      the sky alone lights it;
    - it borders towards the sun on the object that casts it: less than 0.3 times as much of its
      edge there is alike, unlike a street's, or ground of another colour lies outside;
    - at most 15 % of its edge is faint, unlike an area that a level cuts out of ground of one kind.

    Areas are searched at nine levels, and do not overlap. Shaded lawns are not found, and neither
    are shadows with hardly any light outside them (in narrow streets) or under a bright overcast
    sky, which is not bluer.
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
    taken = np.zeros(brightness.shape, bool)
    apart = []
    for _, shadow in sorted(found, key=lambda each: -each[0]):
        if not (taken & shadow.inside).any():
            taken |= shadow.inside
            apart.append(shadow)
    return apart


def light_left(shadows: Iterable[CastShadow]) -> tuple[float, float, float] | None:
    """Returns the share of red, green and blue light in shadows, the median along their edges.

    It is None with less than 10 m of edge.
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
    gsd_m: float,
) -> UInt8[np.ndarray, "H W"]:
    """Draws a tile's map of shadows, as `BackgroundTile.shade` says, with soft edges.

    Areas whose light differs much from the picture's `light_left` (by 0.4, natural logarithm) are
    skipped: they have another material.
    """
    shade = np.zeros(size_px)
    for each in shadows:
        if np.abs(np.median(each.ratios, axis=0) - np.log(left)).max() > LIKE_OTHERS:
            continue
        fine = np.repeat(np.repeat(each.inside, each.cell_px, 0), each.cell_px, 1)
        shade[: fine.shape[0], : fine.shape[1]][fine] = 255
    return np.round(ndimage.gaussian_filter(shade, PENUMBRA_M / gsd_m)).astype(np.uint8)


def _cells(image: Pixels, light: Light, cell_px: int) -> Array:
    """Averages the light over whole cells, `[3, rows, columns]`, at least `DARKEST`."""
    linear = srgb_to_linear(image.double() / 255)
    black = np.asarray(light.black)[:, None, None]
    averaged: Array = F.avg_pool2d(linear, cell_px).numpy() - black
    return np.maximum(averaged, DARKEST)


def _lit_level(brightness: Array, ground: Mask, cell_m: float) -> Array:
    """Returns the brightness of lit ground around each cell, or of the tile with little ground."""
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
    # Percentiles come from counts at each brightness, so that memory does not grow.
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
    """Yields the score, cells and edge ratios of each dark area in shadow."""
    areas, number = ndimage.label(dark)
    large = np.bincount(areas.ravel(), minlength=number + 1) * cell_m**2 >= SMALLEST_M2
    large[0] = False
    dark = large[areas]
    if not dark.any():
        return
    edge, inner, outer = _sides(logarithms, dark, ground, cell_m)
    area_of = areas[edge]
    ratios = inner - outer
    darker = -ratios.mean(0)
    bluer = ratios[2] - ratios[0]
    shadow = (darker > LEAST_DARKER) & (darker < MOST_DARKER) & (bluer > LEAST_BLUER)
    down, right = np.gradient(ndimage.gaussian_filter(dark.astype(np.float64), 2))
    # The way out of an area is against its gradient.
    steepness = np.hypot(down, right)[edge] + 1e-9
    outwards = -(fall[0] * right[edge] + fall[1] * down[edge]) / steepness

    def counted(chosen: Mask) -> NDArray[np.int64]:
        return np.bincount(area_of[chosen], minlength=number + 1)

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
        far = (area_of == area) & far_side & shadow
        near = (area_of == area) & sun_side & shadow
        if sun_side_good[area] > SUN_SIDE_SHARE * good[area]:
            difference = np.median(outer[:, far], axis=1) - np.median(outer[:, near], axis=1)
            if np.abs(difference).max() < ALIKE:
                continue
        yield int(2 * good[area] - on_far_side[area]), areas == area, ratios[:, far].T


def _sides(logarithms: Array, dark: Mask, ground: Mask, cell_m: float) -> tuple[Mask, Array, Array]:
    """Returns the edge of dark areas with ground on both sides, and the means there, `[3, e]`."""
    depth_m = ndimage.distance_transform_edt(dark) * cell_m
    distance_m = ndimage.distance_transform_edt(~dark) * cell_m
    inside = (depth_m > RING_M[0]) & (depth_m < RING_M[1])
    outside = ground & (distance_m > RING_M[0]) & (distance_m < RING_M[1])
    size = 2 * round(1.25 / cell_m) + 1
    shares = [ndimage.uniform_filter(ring.astype(np.float64), size) for ring in (inside, outside)]
    edge = (depth_m > 0) & (depth_m < 1.01 * cell_m) & (shares[0] > 0.1) & (shares[1] > 0.1)
    inner, outer = (
        ndimage.uniform_filter(np.where(ring, logarithms, 0.0), (1, size, size))[:, edge]
        / share[edge]
        for ring, share in zip((inside, outside), shares, strict=True)
    )
    return edge, inner, outer


def _disk(radius: float) -> Mask:
    reach = max(1, math.floor(radius))
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk: Mask = np.hypot(down, right) <= reach + 0.3
    return disk


def shaded_tiles(backgrounds: BackgroundSet) -> list[BackgroundTile]:
    """Returns a cleared set's tiles with the sky's light and new maps of shadows in its folder.

    The sky's share is the light left in the cast shadows of a photograph, on up to 31 of its tiles.
    Tiles stay unchanged if these show too little, without a known sun, and under an overcast sky.
    """
    tiles = backgrounds.all_tiles()
    shaded: dict[str, BackgroundTile] = {}
    for own in by_picture(tiles).values():
        shaded.update({tile.id: tile for tile in _shaded(backgrounds, own)})
    return [shaded.get(tile.id, tile) for tile in tiles]


def lights_record(
    tiles: Sequence[BackgroundTile],
    lights: Mapping[str, Light | None],
    kept: Sequence[BackgroundTile],
) -> dict[str, Any]:
    """Lists suns, overcast photographs, and cleared tiles with shadows.

    `lights` are those of `measured_lights` for all tiles, `kept` those of `shaded_tiles`.
    """
    of_tiles = ((picture_of(tile), lights[tile.id]) for tile in tiles if tile.kind is None)
    known = {picture: light for picture, light in of_tiles if light is not None}
    return {
        "suns": {name: asdict(light.sun) for name, light in known.items() if light.sun is not None},
        "overcast": [name for name, light in known.items() if light.sky == OVERCAST_SKY],
        "photographs": len(known),
        "shaded": [tile.id for tile in kept if tile.kind is None and tile.shade is not None],
    }


def _shaded(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile]
) -> Iterator[BackgroundTile]:
    """Shades the tiles of one picture."""
    known = {tile.id: _shadows(backgrounds, tile) for tile in some_of(tiles)}
    left = light_left(shadow for shadows in known.values() for shadow in shadows)
    if left is None:
        return
    for tile in tiles:
        light = replace(tile.light or backgrounds.light, sky=sky_of(left))
        shade = tile.shade
        if shade is None:
            shadows = known[tile.id] if tile.id in known else _shadows(backgrounds, tile)
            size_px = (tile.height_px, tile.width_px)
            values = shade_map(shadows, left, size_px, backgrounds.gsd_m)
            shade = save_map(backgrounds.folder, "shade", tile.id, values)
        yield replace(tile, light=light, shade=shade)


def _shadows(backgrounds: BackgroundSet, tile: BackgroundTile) -> list[CastShadow]:
    light = tile.light or backgrounds.light
    if light.sun is None or light.sky == OVERCAST_SKY:
        return []
    return find_cast_shadows(backgrounds.pixels(tile.id), light, light.sun, gsd_m=backgrounds.gsd_m)
