"""Random scenes: how many vehicles, where, which way, under which camera, sun and weather (PAPER 5, 6, 56)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Camera, Placement, Scene, Sun
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.weather import LOW_SUN_ELEVATION_RAD, draw_weather

__all__ = ["rectangles_overlap", "sample_scenes"]

Rectangle = tuple[float, float, float, float, float]
"""Centre x, centre y, heading, length, width; metres and radians."""

TRIES = 2000

WIDEST_GAP_M = (0.6, 1.5)
"""Between parked vehicles side by side and bumper to bumper, on top of `gap_m`; our estimate."""
LARGEST_SKEW_RAD = math.radians(3)


def sample_scenes(
    settings: SceneSettings,
    backgrounds: BackgroundSet,
    split: str,
    vehicle_sizes_m: Mapping[str, tuple[float, float, float]],
    count: int,
    *,
    generator: torch.Generator,
    prefix: str = "scene",
) -> list[Scene]:
    """Draws scenes: uniform positions and headings, no two vehicles overlapping, uniform vehicles and backgrounds.

    Args:
        settings: how.
        backgrounds: the ground under them.
        split: of the backgrounds.
        vehicle_sizes_m: per vehicle id its length, width and height; every id is equally likely.
        count: how many scenes.
        generator: every scene takes one 63-bit seed from it and draws all else from that seed.
        prefix: ids are `<prefix>-<number>`.

    Raises:
        ConfigurationError: another resolution than the backgrounds', no tile large enough, no vehicles to choose
            from, or too many vehicles for the image.
    """
    if not math.isclose(settings.gsd_m, backgrounds.gsd_m, rel_tol=1e-6):
        raise ConfigurationError(
            f"The scenes ask for {settings.gsd_m} m per pixel but {backgrounds.folder} has {backgrounds.gsd_m} m; "
            "use one and the same."
        )
    if settings.vehicles_maximum > 0 and not vehicle_sizes_m:
        raise ConfigurationError("There is no vehicle to place; give a fleet with at least one.")
    scenes = []
    for number in range(count):
        seed = int(torch.randint(2**63 - 1, (1,), generator=generator))
        own = torch.Generator().manual_seed(seed)
        window = backgrounds.sample_window(split, settings.size_px, generator=own)
        radius, camera_turn, sun_turn, sun_height = torch.rand(
            4, dtype=torch.float64, generator=own
        ).tolist()
        low, high = settings.sun_elevation_minimum_rad, settings.sun_elevation_maximum_rad
        placements = _sample_placements(settings, vehicle_sizes_m, generator=own)
        # Drawn last, so that everything else is the same whatever the conditions.
        condition = settings.conditions[
            int(torch.randint(len(settings.conditions), (1,), generator=own))
        ]
        strength = float(torch.rand(1, dtype=torch.float64, generator=own))
        if condition == "low_sun":
            (low, high), sun_height = LOW_SUN_ELEVATION_RAD, strength
        scenes.append(
            Scene(
                id=f"{prefix}-{number:06d}",
                background=window,
                camera=Camera(
                    # The square root makes the point uniform on the disc's area.
                    tilt_rad=math.asin(math.sqrt(radius) * math.sin(settings.tilt_maximum_rad)),
                    azimuth_rad=2 * math.pi * camera_turn,
                    gsd_m=settings.gsd_m,
                    size_px=settings.size_px,
                ),
                sun=Sun(
                    azimuth_rad=2 * math.pi * sun_turn,
                    elevation_rad=low + (high - low) * sun_height,
                ),
                placements=placements,
                seed=seed,
                weather=draw_weather(condition, strength),
            )
        )
    return scenes


def _sample_placements(
    settings: SceneSettings,
    vehicle_sizes_m: Mapping[str, tuple[float, float, float]],
    *,
    generator: torch.Generator,
) -> tuple[Placement, ...]:
    """Draws all vehicles at once until none overlap, so that free layouts stay equally likely."""
    span = settings.vehicles_maximum - settings.vehicles_minimum + 1
    number = settings.vehicles_minimum + int(torch.randint(span, (1,), generator=generator))
    if number == 0:
        return ()
    names = sorted(vehicle_sizes_m)
    chosen = [names[i] for i in torch.randint(len(names), (number,), generator=generator).tolist()]
    # Nothing is drawn where nobody parks, so that such scenes stay as they always were.
    if settings.parked_share and float(torch.rand(1, generator=generator)) < settings.parked_share:
        parked = _park(chosen, settings, vehicle_sizes_m, generator=generator)
        if len(parked) >= settings.vehicles_minimum:
            return parked
    for _ in range(TRIES):
        draws = torch.rand(number, 3, dtype=torch.float64, generator=generator).tolist()
        placements = tuple(
            Placement(
                name,
                (2 * x - 1) * settings.half_m,
                (2 * y - 1) * settings.half_m,
                2 * math.pi * turn,
            )
            for name, (x, y, turn) in zip(chosen, draws, strict=True)
        )
        rectangles = [
            _footprint(placement, vehicle_sizes_m, settings.gap_m) for placement in placements
        ]
        if not any(
            rectangles_overlap(rectangles[i], rectangles[j])
            for i in range(number)
            for j in range(i)
        ):
            return placements
    raise ConfigurationError(
        f"No room was found for {number} vehicles in an image of {settings.size_px} px; "
        "place fewer vehicles or choose a larger image."
    )


def _park(
    names: list[str],
    settings: SceneSettings,
    vehicle_sizes_m: Mapping[str, tuple[float, float, float]],
    *,
    generator: torch.Generator,
) -> tuple[Placement, ...]:
    """One row around a uniform place, bumper to bumper or side by side; vehicles beyond the margin are left out."""
    x, y, turn, kind = torch.rand(4, dtype=torch.float64, generator=generator).tolist()
    side_by_side, row_rad = kind < 0.5, 2 * math.pi * turn
    places, reached = [], 0.0
    for name, draws in zip(
        names,
        torch.rand(len(names), 3, dtype=torch.float64, generator=generator).tolist(),
        strict=True,
    ):
        length_m, width_m, _ = vehicle_sizes_m[name]
        taken = width_m if side_by_side else length_m
        gap_m = settings.gap_m + draws[0] * (WIDEST_GAP_M[0] if side_by_side else WIDEST_GAP_M[1])
        heading = (
            row_rad + (math.pi / 2 if side_by_side else 0.0) + (2 * draws[1] - 1) * LARGEST_SKEW_RAD
        )
        places.append((reached + taken / 2, heading + (math.pi if draws[2] < 0.5 else 0.0)))
        reached += taken + gap_m
    rows = (
        Placement(
            name,
            (2 * x - 1) * settings.half_m + (place - reached / 2) * math.cos(row_rad),
            (2 * y - 1) * settings.half_m + (place - reached / 2) * math.sin(row_rad),
            heading % (2 * math.pi),
        )
        for name, (place, heading) in zip(names, places, strict=True)
    )
    return tuple(one for one in rows if max(abs(one.x_m), abs(one.y_m)) <= settings.half_m)


def _footprint(
    placement: Placement, vehicle_sizes_m: Mapping[str, tuple[float, float, float]], gap_m: float
) -> Rectangle:
    length_m, width_m, _ = vehicle_sizes_m[placement.vehicle]
    return placement.x_m, placement.y_m, placement.heading_rad, length_m + gap_m, width_m + gap_m


def rectangles_overlap(first: Rectangle, second: Rectangle) -> bool:
    """True where two turned rectangles share area, by the separating axis test."""
    dx, dy = second[0] - first[0], second[1] - first[1]
    for heading in (first[2], second[2]):
        for axis_rad in (heading, heading + math.pi / 2):
            distance = abs(dx * math.cos(axis_rad) + dy * math.sin(axis_rad))
            if distance >= _half_extent(first, axis_rad) + _half_extent(second, axis_rad):
                return False
    return True


def _half_extent(rectangle: Rectangle, axis_rad: float) -> float:
    _, _, heading, length, width = rectangle
    return (
        length * abs(math.cos(axis_rad - heading)) + width * abs(math.sin(axis_rad - heading))
    ) / 2
