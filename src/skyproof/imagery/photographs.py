"""Measures how photographs show the world: their blur, noise, exposure, and dated sun."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import TypeVar

import numpy as np
import torch
from astral import Observer
from astral.sun import azimuth, elevation
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from skyproof.datasets.pictures import Pixels
from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.flights import by_flight
from skyproof.imagery.notes import ImageNote
from skyproof.imagery.tiles.georeference import DEGREES, Point, to_reference_system
from skyproof.imagery.tiles.grid import Cell
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate, rounded_levels
from skyproof.scenes.sensor import Sensor

Array = NDArray[np.float64]
Item = TypeVar("Item")

EDGES_PER_IMAGE = 400
LEAST_EDGES = 100
LEAST_STEP = 0.08
"""In linear light: fainter edges drown in noise."""
SHARPEST_SHARE = 0.25
REACH_PX = 12
LARGEST_PX = 768
"""Only the middle of an image is measured, so that memory does not grow with it."""
STEP_PX = 0.25

_TILES_MEASURED = 16
STRIDE_PX = 3
FEWEST_PIXELS = 20_000
BRIGHT_SHARE = 0.999
DARK_SHARE = 0.002
GREY_SATURATION = 0.12
FEWEST_GREY = 0.02

# Brightness of white against the brightest thousandth of the ground (road markings, light roofs)
# and against its median, fitted on drawn ground, whose white is known. On a single tile of 37 m the
# first is right within a quarter, the second within two fifths, hence the weight.
_WHITE_OF_BRIGHTEST = 1.6
_WHITE_OF_MEDIAN = 6.6
_WEIGHT_OF_BRIGHTEST = 0.8
_LEAST_WHITE, _LARGEST_WHITE = 0.3, 4.0
# Pixels nearer to a vehicle's middle do not count as ground.
_VEHICLE_M = 3.5
# White may lie above the brightest value only if the ground itself reaches this brightness.
_CLIPPED = 0.955
# Brightness of a surface in deep shadow as a share of white.
_DEEPEST = 0.01
# Vehicles cannot be counted in a photograph under a lower sun.
_LOWEST_DEG = 5.0


def measure_sensor(images: Iterable[Pixels]) -> Sensor:
    """Measures blur and noise of photographs; the paper has one blur for all (section S2.1).

    A step behind a Gaussian blur rises at most by step / (σ √(2π)) per pixel. Edges in the world
    may be soft, but none is sharper than the sensor, so the lower quartile over the strongest edges
    is taken. Noise is the spread of the difference from a 3 x 3 median in the plainest cells.
    """
    sigmas: list[Array] = []
    spreads: list[float] = []
    for whole in images:
        top, left = (max(0, (side - LARGEST_PX) // 2) for side in whole.shape[1:])
        image = whole[:, top : top + LARGEST_PX, left : left + LARGEST_PX]
        grey = srgb_to_linear(image.double() / 255).mean(0).numpy()
        sigmas.append(_edge_blurs(grey))
        spreads.append(_noise(image.double().mean(0).numpy() / 255))
    blurs = np.concatenate(sigmas) if sigmas else np.zeros(0)
    if len(blurs) < LEAST_EDGES:
        raise ImageryError(
            f"Measuring the blur of imagery expects at least {LEAST_EDGES} clear edges but found "
            f"{len(blurs)}; give sharper or larger images."
        )
    return Sensor(
        blur_sigma_px=round(float(np.quantile(blurs, SHARPEST_SHARE)), 2),
        noise=round(float(np.median(spreads)), 4),
    )


def _edge_blurs(grey: Array) -> Array:
    """Returns σ in pixels at the strongest edges of one image."""
    # The strongest edges: local maxima of the slope, away from the border.
    across_x = ndimage.gaussian_filter(grey, 0.7, order=(0, 1))
    across_y = ndimage.gaussian_filter(grey, 0.7, order=(1, 0))
    strength = np.hypot(across_x, across_y)
    inner = np.zeros(grey.shape, bool)
    inner[REACH_PX + 2 : -REACH_PX - 2, REACH_PX + 2 : -REACH_PX - 2] = True
    strongest = strength == ndimage.maximum_filter(strength, 5)
    rows, columns = np.nonzero(inner & strongest & (strength > 0))
    order = np.argsort(-strength[rows, columns], kind="stable")[:EDGES_PER_IMAGE]
    rows, columns = rows[order], columns[order]
    # Brightness along three lines across each edge, so that no corner or speck counts as an edge.
    x = across_x[rows, columns] / strength[rows, columns]
    y = across_y[rows, columns] / strength[rows, columns]
    offsets = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    side = np.array([-1.0, 0.0, 1.0])[:, None, None]
    down = rows[:, None] + offsets * y[:, None] + side * x[:, None]
    right = columns[:, None] + offsets * x[:, None] - side * y[:, None]
    profile = ndimage.map_coordinates(grey, [down, right], order=3).mean(0)
    # The blur from height and steepness of the step, with a window that follows it.
    steepest = (np.diff(profile, axis=1) / STEP_PX).max(1)
    middle = profile.shape[1] // 2
    sigma = np.full(len(profile), 1.0)
    for _ in range(4):
        # The window ends with the edge, because something else lies beyond.
        width = np.clip(np.round(3 * sigma / STEP_PX), 6, middle).astype(int)
        rises = [
            row[middle : middle + w + 1].max() - row[middle - w : middle + 1].min()
            for row, w in zip(profile, width, strict=True)
        ]
        step = np.array(rises)
        sigma = step / (np.maximum(steepest, 1e-9) * np.sqrt(2 * np.pi))
    return sigma[step > LEAST_STEP] if len(sigma) else sigma


def _noise(grey: Array) -> float:
    """Measures the standard deviation of one colour channel's noise, in sRGB units."""
    rest = grey - ndimage.median_filter(grey, 3)
    height, width = (side // 8 * 8 for side in grey.shape)
    cells = rest[:height, :width].reshape(height // 8, 8, width // 8, 8).std(axis=(1, 3)).ravel()
    return float(np.quantile(cells, 0.05))


def picture_of(tile: BackgroundTile) -> str:
    """Names the picture that a tile shows: its source image, or its id if it is drawn."""
    return tile.source if tile.kind is None else tile.id


def some_of(tiles: Sequence[Item]) -> Sequence[Item]:
    """Takes every n-th tile, at most 31, so that measuring does not grow with the imagery."""
    return tiles[:: max(1, len(tiles) // _TILES_MEASURED)]


def ground_pixels(
    image: Pixels, vehicles_px: Sequence[Point], *, gsd_m: float
) -> UInt8[Tensor, "P 3"]:
    """Takes every third pixel along and across, but none near a vehicle: its paint may glint."""
    sampled = image[:, ::STRIDE_PX, ::STRIDE_PX]
    rows, columns = sampled.shape[1:]
    x = torch.arange(columns) * STRIDE_PX + 0.5
    y = torch.arange(rows) * STRIDE_PX + 0.5
    free = torch.ones(rows, columns, dtype=torch.bool)
    for middle_x, middle_y in vehicles_px:
        distance_px = torch.hypot(x[None] - middle_x, y[:, None] - middle_y)
        free &= distance_px * gsd_m > _VEHICLE_M
    return sampled[:, free].T


def measure_exposure(grounds: Iterable[UInt8[Tensor, "P 3"]]) -> Light:
    """Measures white, black and white balance from `ground_pixels` of tiles of one flight.

    White comes from the brightest thousandth of the ground and from its median, its colour from
    nearly grey ground, and black from the darkest 0.2 % of each channel. White burns out only if
    the ground itself does, because cameras are exposed for the brightest parts that they see.
    Ground of one kind, such as snow, misleads this, and a tint over a tenth is found only in part.
    """
    pixels = np.concatenate([np.zeros((0, 3), np.uint8), *(each.numpy() for each in grounds)])
    if len(pixels) < FEWEST_PIXELS // STRIDE_PX**2 or pixels.max() - pixels.min() < STRIDE_PX:
        raise ImageryError(
            "Measuring the light of imagery expects ground with something bright and something "
            f"dark on it but found {len(pixels)} pixels of nearly one colour; give more imagery."
        )
    table = srgb_to_linear(torch.arange(256, dtype=torch.float64) / 255).numpy()
    light: Array = np.take(table, pixels)
    brightest, median = np.quantile(light.mean(1), (BRIGHT_SHARE, 0.5))
    logarithm = _WEIGHT_OF_BRIGHTEST * np.log(_WHITE_OF_BRIGHTEST * brightest)
    logarithm += (1 - _WEIGHT_OF_BRIGHTEST) * np.log(_WHITE_OF_MEDIAN * max(median, 1e-3))
    largest = _LARGEST_WHITE if brightest >= _CLIPPED else 1.0
    white = float(np.clip(np.exp(logarithm), _LEAST_WHITE, largest))
    spread = pixels.max(1).astype(float) - pixels.min(1)
    grey = light[spread <= GREY_SATURATION * np.maximum(pixels.max(1), 1)]
    middle = np.median(grey, axis=0) if len(grey) >= FEWEST_GREY * len(pixels) else np.ones(3)
    # Ground that is mostly black tells no tint.
    balance = middle / middle.mean() if middle.any() else np.ones(3)
    black = np.clip(np.quantile(light, DARK_SHARE, axis=0) - _DEEPEST * white, 0.0, 0.3)
    return Light(white=rounded_levels(white * balance), black=rounded_levels(black))


def lit_tiles(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    suns: Mapping[str, SunEstimate],
    vehicles_px: Mapping[str, Sequence[Point]],
    notes: list[str],
) -> list[BackgroundTile]:
    """Returns the tiles with the light that was measured on their flights, and with their suns."""
    lights: dict[str, Light] = {}
    whites: list[float] = []
    for of_flight in by_flight(tiles):
        light, told = Light(), None
        try:
            light = exposure_of(backgrounds, of_flight, vehicles_px)
            whites.append(sum(light.white) / 3)
            if whites[-1] < _LEAST_WHITE + 0.001:
                told = (
                    "so dark that it seems to be taken at night; vehicles will be drawn as in dim "
                    "daylight, without lamps"
                )
        except ImageryError:
            told = (
                "too plain to measure its exposure; vehicles will be drawn as on a clear day, well "
                "exposed"
            )
        if told is not None:
            notes += [ImageNote(one, told) for one in dict.fromkeys(t.source for t in of_flight)]
        lights |= {one.id: replace(light, sun=suns.get(one.id)) for one in of_flight}
    if whites:
        notes.append(
            f"exposure measured: white in the open sun would be shown as {min(whites):.2f} to "
            f"{max(whites):.2f} of the brightest value; vehicles will be drawn alike"
        )
    return [replace(tile, light=lights[tile.id]) for tile in tiles]


def exposure_of(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    vehicles_px: Mapping[str, Sequence[Point]],
) -> Light:
    """Measures the exposure of one flight on some of its tiles, away from vehicles."""
    return measure_exposure(
        ground_pixels(backgrounds.pixels(one.id), vehicles_px[one.id], gsd_m=backgrounds.gsd_m)
        for one in some_of(tiles)
    )


def sun_over(cell: Cell, taken: datetime) -> SunEstimate:
    """Computes the position of the sun over a cell, in the cell's axes, without refraction."""
    left, bottom, right, top = cell.extent
    middle = ((left + right) / 2, (bottom + top) / 2)
    above = (middle[0], middle[1] + 100.0)
    if cell.crs is None:
        raise ImageryError(
            "--source.taken expects georeferenced images, because the sun of a date and time "
            "depends on the place, but some have no georeference; leave it out, and let "
            "`skyproof clear` measure the sun from the vehicles' shadows."
        )
    (longitude, latitude), (east, north) = to_reference_system(cell.crs, DEGREES, [middle, above])
    # Angle from the cell's y axis clockwise to true north.
    grid_rad = math.atan2((east - longitude) * math.cos(math.radians(latitude)), north - latitude)
    place = Observer(latitude, longitude)
    height_deg = elevation(place, taken, with_refraction=False)
    if height_deg < _LOWEST_DEG:
        raise ImageryError(
            f"--source.taken expects a time of day, but at {taken.isoformat()} the sun stood at "
            f"{height_deg:.0f} degrees over {latitude:.2f} N, {longitude:.2f} E; check the time "
            "zone."
        )
    from_grid_north_rad = math.radians(azimuth(place, taken)) - grid_rad
    return SunEstimate(
        azimuth_rad=round((math.pi / 2 - from_grid_north_rad) % (2 * math.pi), 4),
        elevation_rad=round(math.radians(height_deg), 4),
        known_from=f"date and time, {taken.isoformat()}",
    )
