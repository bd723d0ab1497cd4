"""Measures sun and sky of a photograph from the shadows of the vehicles in it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from skyproof.errors import ImageryError
from skyproof.geometry.colour import srgb_to_linear
from skyproof.imagery.clearing.shared_sun import FEWEST_TO_SHARE, shared_sun, turned
from skyproof.imagery.clearing.vehicle_masks import (
    FAINTEST_SHADOW,
    FEWEST_VEHICLES,
    LAYER_M,
    NEAR_M,
    arrival,
    covered_ground,
    darkness_profiles,
    shadow_side,
    stack_profiles,
    window_around,
)
from skyproof.imagery.exposure import ground_pixels, measure_exposure, some_of
from skyproof.scenes.background_index import BackgroundTile
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate, rounded_levels
from skyproof.scenes.places import RemovedVehicle

Array = NDArray[np.float64]

HEIGHT_M = 1.5
"""Of the usual vehicle: the median of the catalogue's saloons, hatchbacks and estates."""
END_SHARE = 0.35
# A shadow's length from where its darkness ends: fitted on rendered scenes with the sun at 15 to 70
# degrees, within 2.2 degrees (standard deviation), a little more where headings are estimated.
_STRETCH, _HIDDEN_M = 1.36, 0.12
_ELEVATION_SD_RAD = math.radians(3)
_RESAMPLES = 60
_LARGEST_SD_RAD = math.radians(30)
_LOWEST_RAD, _HIGHEST_RAD = math.radians(8), math.radians(80)

# Around a vehicle's own outline even the shadow of a high sun is wider than half of this.
_NEAR_M = 0.5
# Shadows are read from here on outwards, so that no part of the vehicle is in them,
_FROM_M = 0.12
# up to this share of their length, so that no soft edge is.
_TO_SHARE = 0.25
_FEWEST_PIXELS = 6
# So close, the vehicle also hides a third of the sky, in both renderers.
_SKY_LEFT = 0.68
_HIGHEST_FOR_SKY_RAD = math.radians(60)

OVERCAST_SKY = (1.0, 1.0, 1.0)
"""All of the light is the sky's where vehicles cast no shadow."""


@dataclass(frozen=True)
class Footprints:
    """The ground that vehicles cover.

    Attributes:
        boxes: as they would be with a heading of 0, pixel xyxy.
        headings_rad: by which each is turned about its middle, from x (right) towards up.
    """

    boxes: Float[Tensor, "n 4"]
    headings_rad: tuple[float, ...]

    @classmethod
    def of(cls, vehicles: Sequence[RemovedVehicle], gsd_m: float) -> Footprints:
        """Takes the vehicles whose heading and sides are known."""
        boxes, headings_rad = [], []
        for one in vehicles:
            if one.heading_rad is None or one.length_m is None or one.width_m is None:
                continue
            along_px, across_px = one.length_m / gsd_m / 2, one.width_m / gsd_m / 2
            boxes.append(
                (
                    one.x_px - along_px,
                    one.y_px - across_px,
                    one.x_px + along_px,
                    one.y_px + across_px,
                )
            )
            headings_rad.append(one.heading_rad)
        return cls(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4), tuple(headings_rad))


def picture_of(tile: BackgroundTile) -> str:
    """Names what tiles under the same sun share: their source image, or their id where drawn."""
    return tile.source if tile.kind is None else tile.id


def by_picture(tiles: Iterable[BackgroundTile]) -> dict[str, list[BackgroundTile]]:
    """Groups the tiles of imagery by the picture they were cut from; drawn ones are left out."""
    groups: dict[str, list[BackgroundTile]] = defaultdict(list)
    for tile in tiles:
        if tile.kind is None:
            groups[picture_of(tile)].append(tile)
    return groups


def measured_lights(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    vehicles: Mapping[str, Sequence[RemovedVehicle]],
) -> dict[str, Light | None]:
    """Measures each tile's light anew: sun and sky by its vehicles' shadows, white beside them.

    White and black are those of the ground without vehicles. What is known stays: the light of
    drawn ground, and a sun of a date and time. Where vehicles cast no shadow, all light is the
    sky's. Where theirs do not tell the sun, it is that of the set's other photographs, if these
    agree (`shared_sun`); and the sky is overcast if at least three others are, and three for each
    that has a sun: of a flight under clouds, vehicles that stand alike may feign one.

    Args:
        backgrounds: the set with the tiles, vehicles still on them.
        vehicles: that stand on them, by tile; those without heading or sides are not used.

    Returns:
        The light of each tile, by its id; None for that of the set.
    """
    lights = {tile.id: tile.light for tile in tiles}
    of_picture = by_picture(tiles)
    of_its_own = {
        picture: _light_by_vehicles(backgrounds, own, vehicles)
        for picture, own in of_picture.items()
    }
    overcast = sum(light.sky == OVERCAST_SKY for light in of_its_own.values())
    suns = [
        light.sun
        for light in of_its_own.values()
        if light.sun is not None and light.sky != OVERCAST_SKY
    ]
    under_clouds = overcast >= FEWEST_TO_SHARE * max(1, len(suns))
    shared = shared_sun(suns)
    for picture, light in of_its_own.items():
        if light.sun is None and light.sky != OVERCAST_SKY:
            light = replace(light, sky=OVERCAST_SKY) if under_clouds else replace(light, sun=shared)
        lights.update({tile.id: light for tile in of_picture[picture]})
    return lights


def _light_by_vehicles(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    vehicles: Mapping[str, Sequence[RemovedVehicle]],
) -> Light:
    """Returns the light of a picture as its ground and its vehicles tell it."""
    known = _exposed(backgrounds, tiles, vehicles)
    gsd_m = backgrounds.gsd_m
    shown = [
        (tile.id, footprints)
        for tile in tiles
        if len((footprints := Footprints.of(vehicles[tile.id], gsd_m)).headings_rad)
    ]
    profiles = [
        darkness_profiles(
            backgrounds.pixels(name), footprints.boxes, footprints.headings_rad, gsd_m=gsd_m
        )
        for name, footprints in shown
    ]
    if casts_no_shadow(profiles):
        return replace(known, sky=OVERCAST_SKY)
    sun = known.sun or estimate_sun(profiles)
    if sun is None:
        return known
    ratios = (
        shadow_light(backgrounds.pixels(name), footprints, sun, known, gsd_m=gsd_m)
        for name, footprints in shown
    )
    return with_sky(replace(known, sun=sun), ratios)


def _exposed(
    backgrounds: BackgroundSet,
    tiles: Sequence[BackgroundTile],
    vehicles: Mapping[str, Sequence[RemovedVehicle]],
) -> Light:
    """Returns the light of a picture: white and black as of the ground beside its vehicles."""
    known = tiles[0].light or backgrounds.light
    grounds = (
        ground_pixels(
            backgrounds.pixels(tile.id),
            torch.tensor([(one.x_px, one.y_px) for one in vehicles[tile.id]]).reshape(-1, 2),
            gsd_m=backgrounds.gsd_m,
        )
        for tile in some_of(tiles)
    )
    try:
        found = measure_exposure(grounds)
    except ImageryError:
        # Too plain to tell; so was it when it was cut.
        return known
    return replace(known, white=found.white, black=found.black)


def casts_no_shadow(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> bool:
    """Says whether vehicles have no dark side, as under an overcast sky.

    It takes 3 vehicles, and a darkest side that differs from the one across by less than 5 % of the
    ground's brightness. On rendered scenes that is 0.09 with the sun at 78 degrees, and 0.05 under
    an overcast sky.
    """
    stacked = stack_profiles(profiles)
    return len(stacked) >= FEWEST_VEHICLES and _side(stacked)[2] < FAINTEST_SHADOW


def estimate_sun(profiles: Iterable[Float[Tensor, "_ directions layers"]]) -> SunEstimate | None:
    """Estimates where the sun stood from how dark the ground beside vehicles is.

    The azimuth is opposite to the shadows' side, its standard deviation that of vehicles drawn
    again. The elevation is that of a vehicle of 1.5 m whose shadow ends where the darkness, less
    that of the side across, falls to 35 % of its largest value. It uses no date, place or north.

    Args:
        profiles: per tile what `darkness_profiles` gives of boxes with their headings.

    Returns:
        None with fewer than 3 vehicles, without clear shadows, or where their side is not clear
        within 30 degrees.
    """
    stacked = stack_profiles(profiles)
    if len(stacked) < FEWEST_VEHICLES:
        return None
    azimuth_rad, profile, contrast = _side(stacked)
    length_m = _length_m(profile)
    if contrast < FAINTEST_SHADOW or length_m is None:
        return None
    # How sure the azimuth is, by drawing the vehicles again.
    rng = np.random.default_rng(0)
    again_rad = np.zeros(_RESAMPLES)
    for index in range(_RESAMPLES):
        again_rad[index], _, _ = _side(stacked[rng.integers(len(stacked), size=len(stacked))])
    azimuth_sd_rad = float(np.sqrt(np.mean(np.square(turned(again_rad - azimuth_rad)))))
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
    image: UInt8[Tensor, "3 H W"],
    vehicles: Footprints,
    sun: SunEstimate,
    light: Light,
    *,
    gsd_m: float,
) -> Float[Tensor, "m 3"]:
    """Measures how much light is left in the shadows of vehicles, red, green and blue.

    It compares the ground in the part of each shadow that lies next to the vehicle with the ground
    as far away on the other side, both less the photograph's black.

    Returns:
        One row for each vehicle with enough free ground on both sides.
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
    """Returns the light with the sky's part that shadows show: the median vehicle's, and what the
    vehicle itself hides of the sky added.

    It stays as it is with fewer than 3 vehicles, and unless the sun is clearly below 60 degrees (by
    two standard deviations): above, hardly any shadow lies beside a vehicle.
    """
    if light.sun is None:
        return light
    if light.sun.elevation_rad + 2 * light.sun.elevation_sd_rad > _HIGHEST_FOR_SKY_RAD:
        return light
    rows = torch.cat([torch.zeros(0, 3), *ratios])
    if len(rows) < FEWEST_VEHICLES:
        return light
    return replace(light, sky=sky_of((rows.median(0).values / _SKY_LEFT).tolist()))


def sky_of(left: Iterable[float]) -> tuple[float, float, float]:
    """Returns the sky's part of the light for what is left in wide shadows, red, green, blue."""
    return rounded_levels(min(max(each, 0.05), 1.0) for each in left)


def _side(stacked: Array) -> tuple[float, Array, float]:
    """Returns the sun's azimuth, the darkness by layer on the shadow's side, and the contrast."""
    (x, y), profile, contrast = shadow_side(stacked, _NEAR_M)
    return math.atan2(y, -x), profile, contrast


def _length_m(profile: Array) -> float | None:
    """Returns a shadow's length; None where it has no end."""
    peak = int(profile[: round(NEAR_M / LAYER_M)].argmax())
    end = END_SHARE * profile[peak]
    for layer in range(peak, len(profile) - 1):
        if profile[layer + 1] < end:
            part = (profile[layer] - end) / (profile[layer] - profile[layer + 1])
            return _STRETCH * (layer + 0.5 + float(part)) * LAYER_M + _HIDDEN_M
    return None
