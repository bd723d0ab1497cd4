"""Infers sun or clouds over a flight from where, and how sharply, its vehicles' shadows end."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skyproof.datasets.pictures import Pixels
from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.clearing.vehicle_masks import FEWEST_VEHICLES, SAMPLE_LIMIT
from skyproof.imagery.flights import by_flight
from skyproof.imagery.photographs import exposure_of, picture_of
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate
from skyproof.scenes.places import RemovedVehicle

OVERCAST_SKY = (1.0, 1.0, 1.0)
"""Without shadows of vehicles, all light is the sky's."""
HARD_M = 0.33
"""A darkness that takes longer to end, from three quarters to a quarter of it, is no shadow of the
sun. Without the sensor's own blur it takes 0.11 to 0.21 m on scenes that are rendered in the sun,
0.25 m where the sky gives 60 % of the light, and 0.53 m under clouds."""
SHADOW_HEIGHT_M = 0.8
"""Height of the edge that ends a vehicle's shadow, its belt line: fitted on rendered scenes with
the sun at 20 to 70 degrees, with an error of 3 degrees."""

# Ground is read along strips across a vehicle's sides, from within its box, which may hold a part
# of the shadow. Strips near corners would read two shadows.
_STEP_M = 0.04
_OUTWARD_M = np.arange(-0.3, 4.0, _STEP_M)
_STRIP_M, _CORNER_M = 0.6, 0.6
_ACROSS_M = np.linspace(-0.2, 0.2, 5)
_DARKEST_WITHIN_M = 0.9
_BEYOND_M = 1.0
# In shares of the ground's brightness: the faintest darkness, and the most uneven ground.
_FAINTEST, _MOST_UNEVEN = 0.3, 0.12
_FEWEST_STRIPS = 12
# A Gaussian blur takes this many standard deviations from a quarter to three quarters.
_QUARTILES = 1.349

# The sun is searched in these steps.
_TURNS_RAD = np.radians(np.arange(0, 360, 5))
_LENGTHS_M = np.arange(0.1, 4.0, 0.1)
# Where the darkness on a side without a shadow ends, and the largest miss that counts.
_NO_SHADOW_M, _LARGEST_MISS_M = 0.1, 0.6
_RESAMPLES = 60
_LARGEST_SD_RAD = math.radians(30)
_ELEVATION_SD_RAD = math.radians(3)
_LOWEST_RAD, _HIGHEST_RAD = math.radians(8), math.radians(80)

Array = NDArray[np.float64]
_Vehicles = Mapping[str, Sequence[RemovedVehicle]]


def measured_lights(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile], vehicles: _Vehicles
) -> dict[str, Light]:
    """Measures the light of each photograph; those of one flight share it.

    The exposure is that of the flight's ground. If the shadows of its vehicles end softly, all
    light is the sky's. If they end sharply and to one side, they give the sun, unless it is known
    by date and time. Otherwise the sun stays unknown.
    """
    lights: dict[str, Light] = {}
    for of_flight in by_flight(tiles):
        change: dict[str, Any] = {}
        middles_px = {
            tile.id: [(one.x_px, one.y_px) for one in vehicles[tile.id]] for tile in of_flight
        }
        # A flight may be too plain to measure, as it was when its tiles were cut.
        with suppress(ImageryError):
            found = exposure_of(backgrounds, of_flight, middles_px)
            change = {"white": found.white, "black": found.black}
        edges = _edges_of_flight(backgrounds, of_flight, vehicles)
        sharpness_px = (of_flight[0].sensor or backgrounds.sensor).blur_sigma_px
        hard = casts_hard_shadows(edges, blur_m=sharpness_px * backgrounds.gsd_m)
        sun = estimate_sun(edges) if hard else None
        if hard is False:
            change["sky"] = OVERCAST_SKY
        for tile in of_flight:
            known = tile.light or backgrounds.light
            lights.setdefault(picture_of(tile), replace(known, sun=known.sun or sun, **change))
    return lights


def lights_record(lights: Mapping[str, Light]) -> dict[str, Any]:
    """Lists the suns of photographs, and the overcast ones."""
    return {
        "suns": {name: asdict(light.sun) for name, light in lights.items() if light.sun},
        "overcast": [name for name, light in lights.items() if light.sky == OVERCAST_SKY],
        "photographs": len(lights),
    }


def _edges_of_flight(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile], vehicles: _Vehicles
) -> Array:
    """Measures the edges beside up to 300 vehicles, evenly over the flight's tiles."""
    count = sum(len(vehicles[tile.id]) for tile in tiles)
    every = max(1, math.ceil(count / SAMPLE_LIMIT))
    rows, before = [np.zeros((0, 4))], 0
    for tile in tiles:
        chosen = [*range(-before % every, len(vehicles[tile.id]), every)]
        if chosen:
            image = backgrounds.pixels(tile.id)
            edges = shadow_edges(image, vehicles[tile.id], chosen, gsd_m=backgrounds.gsd_m)
            edges[:, 0] += before
            rows.append(edges)
        before += len(vehicles[tile.id])
    return np.concatenate(rows)


def shadow_edges(
    image: Pixels, vehicles: Sequence[RemovedVehicle], chosen: Sequence[int], *, gsd_m: float
) -> Array:
    """Measures where the darkness beside the chosen vehicles ends, on strips of even ground.

    A row is the vehicle's number, the direction of the strip in radians from x (right) towards up,
    the distance in metres of the end from the vehicle's side, and the metres in which the
    brightness rises from a quarter to three quarters of the way to the ground's, `[n, 4]`.
    """
    light = srgb_to_linear(image.double() / 255).mean(0).numpy()
    rows = []
    for number in chosen:
        one = vehicles[number]
        if one.heading_rad is None or one.length_m is None or one.width_m is None:
            continue
        sides = ((one.width_m, one.length_m), (one.length_m, one.width_m))
        for side in range(4):
            across_m, along_m = sides[side % 2]
            normal_rad = one.heading_rad + (side + 1) * math.pi / 2
            x, y = math.cos(normal_rad), math.sin(normal_rad)
            # Middles of the strips, places along them, and lines that are averaged.
            middles_m = np.arange(_CORNER_M - along_m / 2, along_m / 2 - _CORNER_M + 0.1, _STRIP_M)
            aside_m = middles_m[:, None, None] + _ACROSS_M
            reach_m = (across_m / 2 + _OUTWARD_M)[:, None]
            places_px = (
                one.y_px - (reach_m * y + aside_m * x) / gsd_m - 0.5,
                one.x_px + (reach_m * x - aside_m * y) / gsd_m - 0.5,
            )
            strips = ndimage.map_coordinates(light, places_px, order=1, cval=math.nan).mean(2)
            found = (edge for edge in map(_edge, strips) if edge is not None)
            rows += [(number, normal_rad, *edge) for edge in found]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _edge(brightness: Array) -> tuple[float, float] | None:
    """Returns how far from the side the darkness of a strip ends, and how long its end takes.

    It is None without a darkness of at least 0.3, or without a metre of even ground beyond it.
    """
    outside = brightness[_OUTWARD_M > 0]
    level = np.quantile(outside[np.isfinite(outside)], 0.75) if np.isfinite(outside).any() else 0
    if level <= 0:
        return None
    share = brightness / level
    darkest = int(np.argmin(np.nan_to_num(share[_OUTWARD_M < _DARKEST_WITHIN_M], nan=1.0)))
    depth = 1 - share[darkest]
    # If a strip never gets so bright, its darkness ends where the strip does.
    bright = (np.append(share[darkest:] > 1 - part * depth, True) for part in (0.75, 0.25))
    begins, ends = (darkest + int(true.argmax()) for true in bright)
    beyond = share[ends : ends + round(_BEYOND_M / _STEP_M)]
    even = len(beyond) == round(_BEYOND_M / _STEP_M) and beyond.std() < _MOST_UNEVEN
    if depth < _FAINTEST or not even or abs(beyond.mean() - 1) > _MOST_UNEVEN:
        return None
    return float(_OUTWARD_M[ends]), (ends - begins) * _STEP_M


def casts_hard_shadows(edges: Array, *, blur_m: float) -> bool | None:
    """Returns whether the median of the `shadow_edges` is sharp, or None if that is unknown.

    The blur, a standard deviation, is the photograph's own. Too few vehicles leave it unknown, as
    does a photograph that blurs every edge as much as clouds do.
    """
    own_m = _QUARTILES * blur_m
    if len(edges) < _FEWEST_STRIPS or len({*edges[:, 0]}) < FEWEST_VEHICLES or own_m > HARD_M:
        return None
    return bool(np.median(edges[:, 3]) < math.hypot(HARD_M, own_m))


def estimate_sun(edges: Array) -> SunEstimate | None:
    """Estimates the position of the sun from the `shadow_edges` of vehicles.

    A shadow ends farther from the sides that turn away from the sun, by the cosine of the turn and
    the cotangent of the elevation. Returns None if the azimuth is uncertain by over 30 degrees
    (bootstrap over vehicles).
    """
    vehicles, of_vehicle = np.unique(edges[:, 0], return_inverse=True)
    if len(vehicles) < FEWEST_VEHICLES:
        return None
    misses = np.zeros((len(vehicles), len(_TURNS_RAD), len(_LENGTHS_M)))
    for row, (_, normal_rad, end_m, _) in zip(of_vehicle, edges, strict=True):
        towards = np.maximum(np.cos(normal_rad - _TURNS_RAD), 0)[:, None]
        miss_m = np.abs(end_m - _NO_SHADOW_M - towards * _LENGTHS_M)
        misses[row] += np.minimum(miss_m, _LARGEST_MISS_M)
    total = misses.sum(0)
    turn = total.min(1).argmin()
    length = total[turn].argmin()
    draws = np.random.default_rng(0).integers(len(vehicles), size=(_RESAMPLES, len(vehicles)))
    errors_rad = np.array([_TURNS_RAD[misses[draw].sum(0).min(1).argmin()] for draw in draws])
    errors_rad = (errors_rad - _TURNS_RAD[turn] + math.pi) % (2 * math.pi) - math.pi
    azimuth_sd_rad = float(np.sqrt(np.mean(np.square(errors_rad))))
    if azimuth_sd_rad > _LARGEST_SD_RAD:
        return None
    elevation_rad = math.atan2(SHADOW_HEIGHT_M, float(_LENGTHS_M[length]))
    return SunEstimate(
        azimuth_rad=round((float(_TURNS_RAD[turn]) + math.pi) % (2 * math.pi), 4),
        elevation_rad=round(min(max(elevation_rad, _LOWEST_RAD), _HIGHEST_RAD), 4),
        azimuth_sd_rad=round(azimuth_sd_rad, 4),
        elevation_sd_rad=round(_ELEVATION_SD_RAD, 4),
        known_from=f"shadows of {len(vehicles)} vehicles",
    )
