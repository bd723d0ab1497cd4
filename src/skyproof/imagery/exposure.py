"""The light of photographs: measured exposure, and the sun of a date and time."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from astral import Observer
from astral.sun import azimuth, elevation
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from skyproof.datasets.pictures import Pixels
from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.tiles.georeference import DEGREES, to_reference_system
from skyproof.imagery.tiles.grid import Cell
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate, rounded_levels

Array = NDArray[np.float64]
Item = TypeVar("Item")

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
# Brightness of a surface in deep shadow as a share of white.
_DEEPEST = 0.01
# Vehicles cannot be counted in a photograph under a lower sun.
_LOWEST_DEG = 5.0


def picture_of(tile: BackgroundTile) -> str:
    """Names the picture that a tile shows: its source image, or its id if it is drawn."""
    return tile.source if tile.kind is None else tile.id


def by_picture(tiles: Iterable[BackgroundTile]) -> dict[str, list[BackgroundTile]]:
    """Groups the tiles of imagery by their picture; drawn tiles are skipped."""
    groups: dict[str, list[BackgroundTile]] = defaultdict(list)
    for tile in tiles:
        if tile.kind is None:
            groups[picture_of(tile)].append(tile)
    return groups


def some_of(tiles: Sequence[Item]) -> Sequence[Item]:
    """Takes every n-th tile, at most 31, so that measuring does not grow with the imagery."""
    return tiles[:: max(1, len(tiles) // _TILES_MEASURED)]


def ground_pixels(
    image: Pixels, vehicles_px: Float[Tensor, "n 2"], *, gsd_m: float
) -> UInt8[Tensor, "P 3"]:
    """Takes every third pixel along and across, except those near the middles (x, y) of vehicles.

    White paint and glints are brighter than any ground (at Munich by half).
    """
    sampled = image[:, ::STRIDE_PX, ::STRIDE_PX]
    rows, columns = sampled.shape[1:]
    x = torch.arange(columns) * STRIDE_PX + 0.5
    y = torch.arange(rows) * STRIDE_PX + 0.5
    free = torch.ones(rows, columns, dtype=torch.bool)
    for middle_x, middle_y in vehicles_px.tolist():
        distance_px = torch.hypot(x[None] - middle_x, y[:, None] - middle_y)
        free &= distance_px * gsd_m > _VEHICLE_M
    return sampled[:, free].T


def measure_exposure(grounds: Iterable[UInt8[Tensor, "P 3"]]) -> Light:
    """Measures white, black and white balance from `ground_pixels` of tiles of one source.

    White comes from the brightest thousandth of the ground and from its median. Its colour is the
    median of pixels whose channels differ by at most 12 %, and neutral if hardly any ground is so
    grey. Black is the darkest 0.2 % of each channel. Ground of one kind, such as a field alone or
    snow, misleads it, and a tint of more than a tenth is found in part.
    """
    samples = [each.numpy() for each in grounds]
    pixels = np.concatenate(samples) if samples else np.zeros((0, 3))
    if len(pixels) < FEWEST_PIXELS // STRIDE_PX**2 or pixels.max() - pixels.min() < STRIDE_PX:
        raise ImageryError(
            "Measuring the light of imagery expects ground with something bright and something "
            f"dark on it but found {len(pixels)} pixels of nearly one colour; give more imagery."
        )
    table = srgb_to_linear(torch.arange(256, dtype=torch.float64) / 255).numpy()
    light: Array = np.take(table, np.asarray(pixels, np.uint8))
    luminance = light.mean(1)
    brightest, median = np.quantile(luminance, (BRIGHT_SHARE, 0.5))
    logarithm = _WEIGHT_OF_BRIGHTEST * np.log(_WHITE_OF_BRIGHTEST * brightest)
    logarithm += (1 - _WEIGHT_OF_BRIGHTEST) * np.log(_WHITE_OF_MEDIAN * max(median, 1e-3))
    white = float(np.clip(np.exp(logarithm), _LEAST_WHITE, _LARGEST_WHITE))
    spread = pixels.max(1).astype(float) - pixels.min(1)
    grey = light[spread <= GREY_SATURATION * np.maximum(pixels.max(1), 1)]
    balance = np.ones(3)
    if len(grey) >= FEWEST_GREY * len(pixels):
        middle = np.median(grey, axis=0)
        balance = middle / middle.mean()
    black = np.clip(np.quantile(light, DARK_SHARE, axis=0) - _DEEPEST * white, 0.0, 0.3)
    return Light(white=rounded_levels(white * balance), black=rounded_levels(black))


def lit_tiles(
    folder: Path,
    tiles: Sequence[BackgroundTile],
    gsd_m: float,
    suns: Mapping[str, SunEstimate],
    vehicles_px: Mapping[str, Float[Tensor, "n 2"]],
    notes: list[str],
) -> list[BackgroundTile]:
    """Measures how each source shows light, and gives it to its tiles; sources may show too little.

    `suns` and the middles of known vehicles come by the tiles' ids.
    """
    backgrounds = BackgroundSet(folder, gsd_m, tiles)
    measured: dict[str, Light] = {}
    for source, of_one in by_picture(tiles).items():
        try:
            measured[source] = exposure_of(backgrounds, of_one, vehicles_px)
        except ImageryError:
            notes.append(
                f"{source}: too plain to measure its exposure; vehicles will be drawn as on a "
                "clear day, well exposed"
            )
    if measured:
        whites = [sum(light.white) / 3 for light in measured.values()]
        notes.append(
            f"exposure measured: white in the open sun would be shown as {min(whites):.2f} to "
            f"{max(whites):.2f} of the brightest value; vehicles will be drawn alike"
        )
    lit = []
    for tile in tiles:
        light = replace(measured.get(tile.source, Light()), sun=suns.get(tile.id))
        lit.append(replace(tile, light=light))
    return lit


def exposure_of(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    vehicles_px: Mapping[str, Float[Tensor, "n 2"]],
) -> Light:
    """Measures the exposure of one source on some of its tiles, away from vehicles."""
    nothing, gsd_m = torch.zeros(0, 2), backgrounds.gsd_m
    return measure_exposure(
        ground_pixels(backgrounds.pixels(tile.id), vehicles_px.get(tile.id, nothing), gsd_m=gsd_m)
        for tile in some_of(tiles)
    )


def sun_over(cell: Cell, taken: datetime) -> SunEstimate:
    """Computes the place of the sun over a cell, in the cell's axes, without refraction."""
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
