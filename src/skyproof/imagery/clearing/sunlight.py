"""Estimates sun and sky of a photograph from the shadows of its vehicles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from skyproof.datasets.pictures import Boxes, Pixels
from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.clearing.vehicle_masks import (
    FAINTEST_SHADOW,
    FEWEST_VEHICLES,
    LAYER_M,
    NEAR_M,
    arrival,
    covered_ground,
    darkness_profiles,
    enough_profiles,
    shadow_side,
    stack_profiles,
    window_around,
)
from skyproof.imagery.photographs import by_picture, exposure_of
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate, rounded_levels
from skyproof.scenes.places import RemovedVehicle

FEWEST_TO_SHARE = 3
"""Fewest photographs that must agree before others take their light."""
WITHIN_RAD = math.radians(20)
KNOWN_FROM = "other photographs of the set"
HEIGHT_M = 1.5
"""Height of a vehicle: the median of the catalogue's saloons, hatchbacks and estates."""
END_SHARE = 0.35
# Factor and addition that turn the end of the darkness into a shadow's length. They are fitted on
# rendered scenes with the sun at 15 to 70 degrees, with an error of 2.2 degrees (standard
# deviation), a little more with estimated headings.
_STRETCH, _HIDDEN_M = 1.36, 0.12
_ELEVATION_SD_RAD = math.radians(3)
_RESAMPLES = 60
_LARGEST_SD_RAD = math.radians(30)
_LOWEST_RAD, _HIGHEST_RAD = math.radians(8), math.radians(80)

# Even the shadow of a high sun is wider than half of this.
_NEAR_M = 0.5
# Shadows are read from this distance, beyond the vehicle, up to this share of their length, before
# their soft edge.
_FROM_M, _TO_SHARE = 0.12, 0.25
_FEWEST_PIXELS = 6
# At this distance the vehicle also hides a third of the sky, in both renderers.
_SKY_LEFT = 0.68
_HIGHEST_FOR_SKY_RAD = math.radians(60)

OVERCAST_SKY = (1.0, 1.0, 1.0)
"""Without shadows of vehicles, all light is the sky's."""

Array = NDArray[np.float64]
_Vehicles = Mapping[str, Sequence[RemovedVehicle]]


def shared_sun(suns: Sequence[SunEstimate]) -> SunEstimate | None:
    """Returns the median of at least 3 suns whose azimuths lie within 20 degrees of it, else None.

    Its standard deviations combine their errors and their differences.
    """
    if len(suns) < FEWEST_TO_SHARE:
        return None
    azimuths_rad = np.array([sun.azimuth_rad for sun in suns])
    elevations_rad = np.array([sun.elevation_rad for sun in suns])
    # The median on a circle is the azimuth with the least sum of turns to the others.
    turns_rad = turned(azimuths_rad[None] - azimuths_rad[:, None])
    middle = int(np.abs(turns_rad).sum(1).argmin())
    if np.abs(turns_rad[middle]).max() > WITHIN_RAD:
        return None
    elevation_rad = float(np.median(elevations_rad))
    off_rad = elevations_rad - elevation_rad
    return SunEstimate(
        azimuth_rad=round(float(azimuths_rad[middle]) % (2 * math.pi), 4),
        elevation_rad=round(elevation_rad, 4),
        azimuth_sd_rad=_deviation([sun.azimuth_sd_rad for sun in suns], turns_rad[middle]),
        elevation_sd_rad=_deviation([sun.elevation_sd_rad for sun in suns], off_rad),
        known_from=KNOWN_FROM,
    )


def turned(angles_rad: Array) -> Array:
    """Returns angles from -pi to pi."""
    return (angles_rad + math.pi) % (2 * math.pi) - math.pi


def _deviation(own_rad: Sequence[float], differences_rad: Array) -> float:
    spread_rad = float(np.sqrt(np.mean(np.square(differences_rad))))
    return round(math.hypot(float(np.median(own_rad)), spread_rad), 4)


@dataclass(frozen=True)
class Footprints:
    """The ground that vehicles cover: boxes as if they headed right, and their headings."""

    boxes: Boxes
    headings_rad: tuple[float, ...]

    @classmethod
    def of(cls, vehicles: Sequence[RemovedVehicle], gsd_m: float) -> Footprints:
        """Takes the vehicles with known heading and sides."""
        boxes, headings_rad = [], []
        for one in vehicles:
            if one.heading_rad is None or one.length_m is None or one.width_m is None:
                continue
            x, y = one.length_m / gsd_m / 2, one.width_m / gsd_m / 2
            boxes.append((one.x_px - x, one.y_px - y, one.x_px + x, one.y_px + y))
            headings_rad.append(one.heading_rad)
        return cls(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4), tuple(headings_rad))


def measured_lights(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile], vehicles: _Vehicles
) -> dict[str, Light]:
    """Measures each photograph's light: sun and sky by vehicles' shadows, the rest by its ground.

    A sun of a date and time stays. If vehicles cast no shadow, all light is the sky's. A sun that
    they do not show is the `shared_sun` of the set's other photographs, unless three of them are
    overcast for each that has a sun, because vehicles that stand alike may imitate a sun.
    """
    lights = {
        name: _light_by_vehicles(backgrounds, of_picture, vehicles)
        for name, of_picture in by_picture(tiles).items()
    }
    sunny = [light for light in lights.values() if light.sky != OVERCAST_SKY]
    suns = [light.sun for light in sunny if light.sun is not None]
    under_clouds = len(lights) - len(sunny) >= FEWEST_TO_SHARE * max(1, len(suns))
    change: dict[str, Any] = {"sky": OVERCAST_SKY} if under_clouds else {"sun": shared_sun(suns)}
    for name, light in lights.items():
        if light.sun is None and light.sky != OVERCAST_SKY:
            lights[name] = replace(light, **change)
    return lights


def lights_record(lights: Mapping[str, Light]) -> dict[str, Any]:
    """Lists the suns of photographs, and the overcast ones."""
    return {
        "suns": {name: asdict(light.sun) for name, light in lights.items() if light.sun},
        "overcast": [name for name, light in lights.items() if light.sky == OVERCAST_SKY],
        "photographs": len(lights),
    }


def _light_by_vehicles(
    backgrounds: BackgroundSet, tiles: Sequence[BackgroundTile], vehicles: _Vehicles
) -> Light:
    """Measures the light of a picture by its ground and its vehicles."""
    gsd_m = backgrounds.gsd_m
    known = tiles[0].light or backgrounds.light
    middles_px = {
        tile.id: torch.tensor([(one.x_px, one.y_px) for one in vehicles[tile.id]]).reshape(-1, 2)
        for tile in tiles
    }
    # A picture may be too plain, as it was when it was cut.
    with suppress(ImageryError):
        found = exposure_of(backgrounds, tiles, middles_px)
        known = replace(known, white=found.white, black=found.black)
    shown = {tile.id: Footprints.of(vehicles[tile.id], gsd_m) for tile in tiles}
    profiles = enough_profiles(
        darkness_profiles(backgrounds.pixels(name), one.boxes, one.headings_rad, gsd_m=gsd_m)
        for name, one in shown.items()
    )
    if casts_no_shadow(profiles):
        return replace(known, sky=OVERCAST_SKY)
    sun = known.sun or estimate_sun(profiles)
    if sun is None:
        return known
    ratios = (
        shadow_light(backgrounds.pixels(name), one, sun, known, gsd_m=gsd_m)
        for name, one in shown.items()
    )
    return with_sky(replace(known, sun=sun), ratios)


def casts_no_shadow(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> bool:
    """Tells whether at least 3 vehicles have no dark side, as under an overcast sky."""
    stacked = stack_profiles(profiles)
    return len(stacked) >= FEWEST_VEHICLES and _side(stacked)[2] < FAINTEST_SHADOW


def estimate_sun(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> SunEstimate | None:
    """Estimates the place of the sun from the `darkness_profiles` of boxes with their headings.

    The elevation follows from the end of the shadow of a vehicle of 1.5 m. It is None with fewer
    than 3 vehicles, without clear shadows, or with an azimuth uncertain by 30 degrees (bootstrap).
    """
    stacked = stack_profiles(profiles)
    if len(stacked) < FEWEST_VEHICLES:
        return None
    azimuth_rad, profile, contrast = _side(stacked)
    length_m = _length_m(profile)
    if contrast < FAINTEST_SHADOW or length_m is None:
        return None
    rng = np.random.default_rng(0)
    draws = (rng.integers(len(stacked), size=len(stacked)) for _ in range(_RESAMPLES))
    errors_rad = turned(np.array([_side(stacked[draw])[0] for draw in draws]) - azimuth_rad)
    azimuth_sd_rad = float(np.sqrt(np.mean(np.square(errors_rad))))
    if azimuth_sd_rad > _LARGEST_SD_RAD:
        return None
    elevation_rad = math.atan2(HEIGHT_M, length_m)
    return SunEstimate(
        azimuth_rad=round(azimuth_rad % (2 * math.pi), 4),
        elevation_rad=round(min(max(elevation_rad, _LOWEST_RAD), _HIGHEST_RAD), 4),
        azimuth_sd_rad=round(azimuth_sd_rad, 4),
        elevation_sd_rad=round(_ELEVATION_SD_RAD, 4),
        known_from=f"shadows of {len(stacked)} vehicles",
    )


def shadow_light(
    image: Pixels, vehicles: Footprints, sun: SunEstimate, light: Light, *, gsd_m: float
) -> Float[Tensor, "m 3"]:
    """Measures the share of red, green and blue light in the shadow of each vehicle, `[m, 3]`.

    It compares the ground next to the vehicle with that on its other side, less the black.
    """
    linear = srgb_to_linear(image.double() / 255) - torch.tensor(light.black)[:, None, None]
    values = linear.clamp(min=0.0).numpy()
    taken = covered_ground(vehicles.boxes, vehicles.headings_rad, values.shape[1:])
    # Rows run down, so the shadow's way is (-cos, sin) there.
    way = (-math.cos(sun.azimuth_rad), math.sin(sun.azimuth_rad))
    across = (-way[0], -way[1])
    to_m = max(_TO_SHARE * HEIGHT_M / math.tan(sun.elevation_rad), 2 * _FROM_M)
    ratios = []
    for box, turn_rad in zip(vehicles.boxes.tolist(), vehicles.headings_rad, strict=True):
        rows, columns = window_around(box, to_m / gsd_m, taken.shape, turn_rad)
        free = ~taken[rows, columns]
        sides = []
        for direction in (way, across):
            distance_m = arrival(box, direction, rows, columns, turn_rad) * gsd_m
            chosen = free & (distance_m > _FROM_M) & (distance_m < to_m)
            if chosen.sum() < _FEWEST_PIXELS:
                break
            sides.append(np.median(values[:, rows, columns][:, chosen], axis=1))
        if len(sides) == 2:
            ratios.append(sides[0] / np.maximum(sides[1], 1e-4))
    return torch.tensor(np.array(ratios).reshape(-1, 3), dtype=torch.float32)


def with_sky(light: Light, ratios: Iterable[Float[Tensor, "_ 3"]]) -> Light:
    """Returns the light with the sky's share in the median vehicle's shadow, if at least 3 show it.

    The light stays unless the sun is below 60 degrees by two standard deviations: above, hardly any
    shadow lies beside a vehicle.
    """
    sun = light.sun
    if sun is None or sun.elevation_rad + 2 * sun.elevation_sd_rad > _HIGHEST_FOR_SKY_RAD:
        return light
    rows = torch.cat([torch.zeros(0, 3), *ratios])
    if len(rows) < FEWEST_VEHICLES:
        return light
    left = (rows.median(0).values / _SKY_LEFT).tolist()
    return replace(light, sky=rounded_levels(min(max(each, 0.05), 1.0) for each in left))


def _side(stacked: Array) -> tuple[float, Array, float]:
    """Returns the sun's azimuth, the darkness by layer on the shadow's side, and the contrast."""
    (x, y), profile, contrast = shadow_side(stacked, _NEAR_M)
    return math.atan2(y, -x), profile, contrast


def _length_m(profile: Array) -> float | None:
    """Returns a shadow's length; None without an end."""
    peak = int(profile[: round(NEAR_M / LAYER_M)].argmax())
    end = END_SHARE * profile[peak]
    for layer in range(peak, len(profile) - 1):
        if profile[layer + 1] < end:
            part = (profile[layer] - end) / (profile[layer] - profile[layer + 1])
            return _STRETCH * (layer + 0.5 + float(part)) * LAYER_M + _HIDDEN_M
    return None
