"""Draws random scenes: number, places and headings of vehicles, camera, sun and weather."""

import itertools
import math
from dataclasses import replace

import torch

from skyproof.errors import ConfigurationError
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import SunEstimate
from skyproof.scenes.placing import SceneDraw, place_vehicles
from skyproof.scenes.scene import Camera, Placement, Scene, Sun
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.standing import Sizes, footprint, standing
from skyproof.scenes.weather import CONDITIONS, LOW_SUN_ELEVATION_RAD

TRIES = 2000

_SHADED_TRIES = 8
# Shares of a footprint from which a vehicle counts as shaded, or as beneath a crown or roof.
_SHADED, _COVERED = 0.5, 0.15

WIDEST_GAP_M = (0.6, 1.5)
"""Widest gaps between vehicles parked side by side and in line, on top of `gap_m`; our estimate."""
LARGEST_SKEW_RAD = math.radians(3)


def sample_scenes(
    settings: SceneSettings,
    backgrounds: BackgroundSet,
    split: str,
    vehicle_sizes_m: Sizes,
    count: int,
    *,
    generator: torch.Generator,
    prefix: str = "scene",
) -> list[Scene]:
    """Draws scenes; by default vehicles, backgrounds and places are uniform. No vehicles overlap.

    Every scene takes one 63-bit seed from `generator` and draws all else from that seed.

    Raises:
        ConfigurationError: there is no vehicle, no tile is large enough, or no room was found.
    """
    half_m = settings.half_m(backgrounds.gsd_m)
    if settings.vehicles_maximum > 0 and not vehicle_sizes_m:
        raise ConfigurationError("There is no vehicle to place; give a fleet with at least one.")
    scenes = []
    for number in range(count):
        seed = int(torch.randint(2**63 - 1, (1,), generator=generator))
        name = f"{prefix}-{number:06d}"
        drawn_from = torch.Generator().manual_seed(seed)
        draw = SceneDraw(settings, backgrounds, split, vehicle_sizes_m, half_m, drawn_from)
        scenes.append(_sample_scene(name, seed, draw))
    return scenes


def _sample_scene(name: str, seed: int, draw: SceneDraw) -> Scene:
    settings, backgrounds, generator = draw.settings, draw.backgrounds, draw.generator
    # For a share of 0 nothing is drawn, so that scenes without these shares never change.
    if settings.empty_share and draw.uniforms(1)[0] < settings.empty_share:
        settings = replace(settings, vehicles_minimum=0, vehicles_maximum=0)
        draw = replace(draw, settings=settings)
    shaded = settings.shaded_share and draw.uniforms(1)[0] < settings.shaded_share
    for _ in range(_SHADED_TRIES if shaded else 1):
        if settings.places == "uniform":
            window = backgrounds.sample_window(draw.split, settings.size_px, generator=generator)
        else:
            window, placements = place_vehicles(draw)
        radius, camera_turn, sun_turn, sun_height = draw.uniforms(4)
        if settings.places == "uniform":
            placements = _sample_placements(draw)
        shadows = settings.sun == "photograph"
        placements = standing(placements, backgrounds, window, draw.sizes_m, shadows=shadows)
        in_shade = any(each.shade > _SHADED or each.covered > _COVERED for each in placements)
        if in_shade or not placements:
            break
    # The weather is drawn last, so that everything else is the same under all conditions.
    choice = int(torch.randint(len(settings.conditions), (1,), generator=generator))
    condition = settings.conditions[choice]
    (strength,) = draw.uniforms(1)
    lowest, highest = settings.sun_elevation_minimum_rad, settings.sun_elevation_maximum_rad
    if condition == "low_sun":
        lowest, highest = LOW_SUN_ELEVATION_RAD
        sun_height = strength
    # The square root makes the point uniform on the disc's area.
    tilt_rad = math.asin(math.sqrt(radius) * math.sin(settings.tilt_maximum_rad))
    camera = Camera(tilt_rad, 2 * math.pi * camera_turn, backgrounds.gsd_m, settings.size_px)
    sun = Sun(2 * math.pi * sun_turn, lowest + (highest - lowest) * sun_height)
    known = backgrounds.light_of(window).sun
    if settings.sun == "photograph" and known is not None:
        photographed = _sun_of(known, window.rotation_rad, generator=generator)
        # A low sun has the azimuth of the photograph's sun, but casts longer shadows.
        low = condition == "low_sun"
        sun = replace(photographed, elevation_rad=sun.elevation_rad) if low else photographed
    weather = CONDITIONS[condition](strength)
    return Scene(name, window, camera, sun, placements, seed, weather)


def _sun_of(known: SunEstimate, rotation_rad: float, *, generator: torch.Generator) -> Sun:
    """Draws the photograph's sun, with its uncertainty, in the axes of a turned window."""
    azimuth, elevation = torch.randn(2, dtype=torch.float64, generator=generator).tolist()
    azimuth_rad = known.azimuth_rad + azimuth * known.azimuth_sd_rad - rotation_rad
    elevation_rad = known.elevation_rad + elevation * known.elevation_sd_rad
    elevation_rad = min(max(elevation_rad, LOW_SUN_ELEVATION_RAD[0]), math.pi / 2)
    return Sun(azimuth_rad % (2 * math.pi), elevation_rad)


def _sample_placements(draw: SceneDraw) -> tuple[Placement, ...]:
    """Draws all vehicles anew until none overlap, so that free layouts are equally likely."""
    settings, half_m, generator = draw.settings, draw.half_m, draw.generator
    number = draw.number()
    if number == 0:
        return ()
    names = sorted(draw.sizes_m)
    chosen = [names[i] for i in torch.randint(len(names), (number,), generator=generator).tolist()]
    # For a share of 0 nothing is drawn, so that scenes without parked vehicles never change.
    if settings.parked_share and float(torch.rand(1, generator=generator)) < settings.parked_share:
        parked = _park(draw, chosen)
        if len(parked) >= settings.vehicles_minimum:
            return parked
    for _ in range(TRIES):
        placements = tuple(
            Placement(name, (2 * x - 1) * half_m, (2 * y - 1) * half_m, 2 * math.pi * turn)
            for name, (x, y, turn) in zip(chosen, draw.uniforms(number, 3), strict=True)
        )
        grounds = [footprint(each, draw.sizes_m, settings.gap_m) for each in placements]
        if not any(one.intersects(other) for one, other in itertools.combinations(grounds, 2)):
            return placements
    raise ConfigurationError(
        f"No room was found for {number} vehicles in an image of {settings.size_px} px; "
        "place fewer vehicles or choose a larger image."
    )


def _park(draw: SceneDraw, names: list[str]) -> tuple[Placement, ...]:
    """Parks vehicles in a row around a uniform place; those beyond the margin are left out."""
    x, y, turn, kind = draw.uniforms(4)
    side_by_side = kind < 0.5
    row_rad = 2 * math.pi * turn
    widest_gap_m = WIDEST_GAP_M[0 if side_by_side else 1]
    # The middle of each vehicle along the row, and its heading.
    slots = []
    reached_m = 0.0
    for name, (gap, skew, side) in zip(names, draw.uniforms(len(names), 3), strict=True):
        length_m, width_m, _ = draw.sizes_m[name]
        taken_m = width_m if side_by_side else length_m
        gap_m = draw.settings.gap_m + gap * widest_gap_m
        across_rad = math.pi / 2 if side_by_side else 0.0
        heading_rad = row_rad + across_rad + (2 * skew - 1) * LARGEST_SKEW_RAD
        slots.append((reached_m + taken_m / 2, heading_rad + (math.pi if side < 0.5 else 0.0)))
        reached_m += taken_m + gap_m
    row = []
    for name, (middle_m, heading_rad) in zip(names, slots, strict=True):
        x_m = (2 * x - 1) * draw.half_m + (middle_m - reached_m / 2) * math.cos(row_rad)
        y_m = (2 * y - 1) * draw.half_m + (middle_m - reached_m / 2) * math.sin(row_rad)
        row.append(Placement(name, x_m, y_m, heading_rad % (2 * math.pi)))
    return tuple(filter(draw.inside, row))
