"""Procedural aerial pictures of ground without vehicles, and background sets of them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from scipy import ndimage
from torch import Tensor

from skyproof.errors import ConfigurationError
from skyproof.ground.canvas import Array, Canvas
from skyproof.ground.kinds import GROUND_KINDS
from skyproof.scenes.background_index import BackgroundTile, save_map, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light, SunEstimate, rounded_levels
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.splits import SPLITS

_SUN_COLOUR = np.asarray([1.03, 1.0, 0.95], np.float32)
_SHOULDER = 0.6


@dataclass(frozen=True)
class GroundSensor:
    """How the lit ground becomes a picture.

    Every tile draws its own sensor, so that a detector cannot rely on one look. The ranges include
    orthophotos from a hazy German town to the red soil of Uganda: tiles have a mean lightness from
    35 to 70 (CIELAB) and a chroma from 2 to 20.
    """

    exposure: float
    haze: float
    tint: tuple[float, float, float]
    saturation: float
    blur_px: float
    noise: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "GroundSensor":
        # White balances differ mostly from yellow to blue.
        warmth = rng.normal(0.0, 0.05)
        red, green, blue = (rng.normal(1.0, 0.02, 3) * (1 + warmth, 1.0, 1 - warmth)).tolist()
        return cls(
            exposure=math.exp(rng.uniform(math.log(0.7), math.log(1.9))),
            haze=0.002 + 0.03 * rng.uniform() ** 2,
            tint=(red, green, blue),
            saturation=rng.uniform(0.8, 1.1),
            blur_px=rng.uniform(0.5, 0.85),
            noise=rng.uniform(0.004, 0.012),
        )


def photograph(
    canvas: Canvas, sensor: GroundSensor
) -> tuple[UInt8[np.ndarray, "3 H W"], Light, UInt8[np.ndarray, "H W"]]:
    """Lights the canvas and takes its picture; returns it, its light and its map of shadows."""
    rng = canvas.rng
    overcast = float(rng.choice([rng.uniform(0.0, 0.15), rng.uniform(0.3, 0.7)], p=[0.75, 0.25]))
    sun = np.float32(1.15 * (1 - overcast))
    sky_strength = rng.uniform(0.12, 0.25) + 0.75 * overcast
    sky = np.full(3, sky_strength, np.float32)
    if overcast < 0.2:
        sky = np.asarray([0.88, 1.0, 1.22], np.float32) * np.float32(sky_strength)
    around = ndimage.uniform_filter(canvas.height, max(3, round(3.0 / canvas.gsd_m)))
    openness = 1 - 0.45 * np.clip((around - canvas.height) / 3.0, 0, 1)
    direct, lit = sunlight(canvas)
    light = sun * direct[..., None] * _SUN_COLOUR + sky * openness[..., None]
    # The blur comes before the crop, so that no border is padded, and before the tone curve, as
    # does the saturation, because optics act on light.
    picture = np.clip(canvas.reflectance, 0.004, 0.95) * light * np.float32(sensor.exposure)
    for channel in range(3):
        ndimage.gaussian_filter(picture[..., channel], sensor.blur_px, output=picture[..., channel])
    picture = picture[canvas.picture]
    grey = picture.mean(2, keepdims=True)
    picture = grey + sensor.saturation * (picture - grey)
    picture = picture * np.asarray(sensor.tint, np.float32) + sensor.haze
    # A soft shoulder instead of hard clipping, as camera tone curves have.
    picture = np.clip(picture, 0, None)
    bent = _SHOULDER + (1 - _SHOULDER) * np.tanh((picture - _SHOULDER) / (1 - _SHOULDER))
    encoded = np.where(picture < _SHOULDER, picture, bent) ** np.float32(1 / 2.2)
    encoded += np.float32(sensor.noise) * rng.standard_normal(encoded.shape, np.float32)
    image = (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)
    shade = np.round((1 - lit[canvas.picture]) * 255).astype(np.uint8)
    level = sun * math.sin(canvas.sun_elevation_rad) * _SUN_COLOUR
    image = np.ascontiguousarray(image.transpose(2, 0, 1))
    return image, _light(canvas, level, sky, sensor), shade


def sunlight(canvas: Canvas) -> tuple[Array, Array]:
    """Returns each pixel's share of the direct sun (shadow and slope), and that by shadow alone."""
    # Shadows: steps towards the sun find the height above which a ray to the sun is free.
    tangent = math.tan(canvas.sun_elevation_rad)
    step_x = math.cos(canvas.sun_azimuth_rad)
    step_y = -math.sin(canvas.sun_azimuth_rad)
    height, n = canvas.height, canvas.pixels
    horizon = np.full_like(height, -1e3)
    distance_px = 1.0
    furthest_px = min(float(np.ptp(height)) / tangent / canvas.gsd_m + 1, n - 1)
    while distance_px <= furthest_px:
        dx = round(distance_px * step_x)
        dy = round(distance_px * step_y)
        here = (slice(max(0, -dy), n - max(0, dy)), slice(max(0, -dx), n - max(0, dx)))
        there = (slice(max(0, dy), n - max(0, -dy)), slice(max(0, dx), n - max(0, -dx)))
        drop = np.float32(distance_px * canvas.gsd_m * tangent)
        np.maximum(horizon[here], height[there] - drop, out=horizon[here])
        distance_px += 1.0 if distance_px < 40 else 2.0
    lit = np.clip(1.0 - (horizon - height) / 0.25, 0, 1)
    lit = ndimage.gaussian_filter(lit.astype(np.float32), 0.7)

    # Slopes that face the sun are brighter.
    gradient_y, gradient_x = np.gradient(ndimage.gaussian_filter(height, 0.6), canvas.gsd_m)
    # Beyond 60 degrees there is a wall and no slope: the roof above it and the ground are level.
    level = np.hypot(gradient_x, gradient_y) > 1.8
    gradient_x[level], gradient_y[level] = 0, 0
    towards_sun = gradient_x * step_x + gradient_y * step_y
    cosine = math.sin(canvas.sun_elevation_rad) - math.cos(canvas.sun_elevation_rad) * towards_sun
    cosine = cosine / np.sqrt(1 + gradient_x**2 + gradient_y**2)
    return (lit * np.clip(cosine, 0, None)).astype(np.float32), lit


def _light(canvas: Canvas, sun: Array, sky: Array, sensor: GroundSensor) -> Light:
    """Returns the light for vehicles; `sun` and `sky` are those on level, open ground."""
    shown = (sun + sky) * sensor.exposure * np.asarray(sensor.tint)
    return Light(
        white=rounded_levels(shown + sensor.haze),
        black=(round(sensor.haze, 4),) * 3,
        shoulder=_SHOULDER,
        sky=rounded_levels(sky / (sun + sky)),
        sun=SunEstimate(
            round(canvas.sun_azimuth_rad, 4), round(canvas.sun_elevation_rad, 4), known_from="drawn"
        ),
    )


@dataclass(frozen=True)
class DrawnGround:
    """A drawn tile `[3, H, W]` with its light and sensor, and maps as in `BackgroundTile`."""

    image: UInt8[Tensor, "3 H W"]
    kind: str
    light: Light
    sensor: Sensor
    directions: UInt8[np.ndarray, "H W"]
    shade: UInt8[np.ndarray, "H W"]
    cover: UInt8[np.ndarray, "H W"]


def draw_ground(size_px: int, gsd_m: float, *, generator: torch.Generator) -> DrawnGround:
    """Draws a tile of a random kind, `[3, size_px, size_px]`, with one draw of the generator.

    Everything is drawn as reflectance and height. One sun lights it, shadows follow from the
    heights, and a random sensor photographs it (haze, tint, blur, noise). There are no vehicles,
    but many things of a vehicle's size. The map of drivable ground allows vehicles in lanes, along
    kerbs, in bays, drives and yards, and on tracks, and none in a park.
    """
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    kind = str(rng.choice(list(GROUND_KINDS), p=[share for _, share in GROUND_KINDS.values()]))
    canvas = Canvas(size_px, gsd_m, rng, axes_rad=rng.uniform(0, 2 * math.pi))
    GROUND_KINDS[kind][0](canvas)
    canvas.mute(rng.uniform(0.35, 1.0))
    camera = GroundSensor.draw(rng)
    image, light, shade = photograph(canvas, camera)
    return DrawnGround(
        torch.from_numpy(image),
        kind,
        light,
        Sensor(round(camera.blur_px, 3), round(camera.noise, 5)),
        canvas.drivable(),
        shade,
        canvas.cover(camera.blur_px),
    )


def write_procedural_backgrounds(
    folder: Path,
    counts: Mapping[str, int],
    size_px: int,
    *,
    seed: int,
    gsd_m: float = 0.125,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> BackgroundSet:
    """Draws a background set of so many tiles per split, each with its sensor.

    Each tile has a seed of its own, so that its bytes do not depend on the number of tiles.
    `progress` is called with (tiles done, tiles in all). Use `finished_folder` around it.

    Raises:
        ConfigurationError: a split has another name.
        RunFolderError: the disk cannot take it.
    """
    unknown = set(counts) - set(SPLITS)
    if unknown:
        raise ConfigurationError(
            f"Unknown split {sorted(unknown)[0]!r}; the splits are {', '.join(SPLITS)}."
        )
    total = sum(counts.values())
    tiles = []
    for split in SPLITS:
        for number in range(counts.get(split, 0)):
            sequence = np.random.SeedSequence([seed % 2**64, SPLITS.index(split), number])
            (state,) = sequence.generate_state(1, np.uint64).tolist()
            generator = torch.Generator().manual_seed(state >> 1)
            ground = draw_ground(size_px, gsd_m, generator=generator)
            tile_id = f"{split}-{number:05d}"
            tile = BackgroundTile(
                id=tile_id,
                file=f"tiles/{tile_id}.png",
                split=split,
                width_px=size_px,
                height_px=size_px,
                source="procedural",
                kind=ground.kind,
                sensor=ground.sensor,
                light=ground.light,
                drivable=save_map(folder, "drivable", tile_id, ground.directions),
                shade=save_map(folder, "shade", tile_id, ground.shade),
                cover=save_map(folder, "cover", tile_id, ground.cover),
            )
            save_tile(folder, tile, ground.image)
            tiles.append(tile)
            progress(len(tiles), total)
    write_index(folder, gsd_m, tiles)
    return BackgroundSet.open(folder)
