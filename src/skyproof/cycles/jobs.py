"""The job of a Blender process: a crop around a vehicle, in daylight, as numbers and arrays."""

import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.cycles.settings import CyclesSettings
from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.lighting import CLEAR, OVERCAST, SkyType, relative_luminance, sky_light
from skyproof.render.materials import material_labels, material_table, reflectance
from skyproof.render.placed import Placed
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Scene, Sun
from skyproof.vehicles.vehicle import VehicleBatch

WORKER = Path(__file__).with_name("worker.py")
# Reach of the ground that sends noticeable light to a crop's vehicles.
_GROUND_BORDER_M = 2.0
_SUN_DIAMETER_RAD = math.radians(0.53)
_SKY_ROWS, _SKY_COLUMNS = 32, 64


def daylight(
    sun: Sun, sky_light: tuple[float, float, float], clouds: float
) -> tuple[list[float], Float[np.ndarray, "32 64 3"]]:
    """Returns linear light on a scene: a white matt surface on open ground has the value 1.

    The sun's irradiance is that across its rays. The sky's radiance is by elevation (90 degrees in
    the first row) and azimuth (the middle column looks along +x, columns go clockwise from above),
    for Blender's environment texture; it is zero below the horizon. `sky_light` is the sky's share
    of the light on open ground, `clouds` the share of clouds in it. The irradiances of both on
    level ground add up to pi in every channel.
    """
    dome = (1 - clouds) * _dome(CLEAR, sun) + clouds * _dome(OVERCAST, sun)
    share = np.array(sky_light)
    direct = np.pi * np.maximum(1 - share, 0.0) / math.sin(sun.elevation_rad)
    return direct.tolist(), (share * dome[..., None]).astype(np.float32)


def _dome(kind: SkyType, sun: Sun) -> Float[np.ndarray, "32 64"]:
    """Returns the sky's luminance, scaled to 1 for a white matt surface under the sky alone."""
    elevation = np.pi / 2 - (np.arange(_SKY_ROWS) + 0.5) * np.pi / _SKY_ROWS
    azimuth = np.pi - (np.arange(_SKY_COLUMNS) + 0.5) * 2 * np.pi / _SKY_COLUMNS
    up = np.broadcast_to(np.sin(elevation)[:, None], (_SKY_ROWS, _SKY_COLUMNS))
    outward = np.cos(elevation)[:, None]
    x, y, z = sun.direction
    towards_sun = outward * (np.cos(azimuth) * x + np.sin(azimuth) * y) + up * z
    luminance = relative_luminance(kind, torch.tensor(up), torch.tensor(towards_sun)).numpy()
    dome = luminance * (up > 0)
    solid_angle = outward * (np.pi / _SKY_ROWS) * (2 * np.pi / _SKY_COLUMNS)
    return dome / ((dome * up * solid_angle).sum() / np.pi)


@dataclass(frozen=True)
class Job:
    """One crop: its name in messages, its image, left, top, width, height in image pixels (which
    may lie beyond the image), camera, sun, samples and seed, and vehicles, ground and sky.
    """

    name: str
    scene: int
    window_px: tuple[int, int, int, int]
    numbers: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def stored(self) -> bytes:
        """Returns the job file: NumPy's .npz, with the numbers as JSON in an array of their own."""
        buffer = io.BytesIO()
        np.savez(buffer, job=np.array(json.dumps(self.numbers)), **self.arrays)  # type: ignore[arg-type]
        return buffer.getvalue()

    def digest(self, blender_version: str) -> str:
        """Returns a name for the result, which also depends on the worker and Blender's version."""
        total = hashlib.sha256(WORKER.read_bytes())
        total.update(json.dumps([blender_version, self.numbers]).encode())
        for name, values in self.arrays.items():
            total.update(f"{name} {values.dtype} {values.shape}".encode())
            total.update(np.ascontiguousarray(values).tobytes())
        return total.hexdigest()


@torch.no_grad()
def crop_windows(placed: Placed, margin_px: int, borders_px: Sequence[int]) -> Int[Tensor, "N 4"]:
    """Returns each vehicle's window (left, top, right, bottom) with cast shadow and a margin.

    Windows end at the image's border plus the sensor's blur; that of a vehicle far off has no area.
    """
    points = torch.cat((placed.screen, placed.shadow_screen), dim=1)
    window = torch.cat(
        (points.amin(1).floor() - margin_px, points.amax(1).ceil() + margin_px), dim=1
    )
    border_px = window.new_tensor(borders_px)[placed.scene, None]
    return window.clamp(-border_px, placed.size_px + border_px).long().cpu()


def crop_jobs(
    scenes: Sequence[Scene],
    vehicles: VehicleBatch,
    placed: Placed,
    ground: Float[Tensor, "B 3 H W"],
    windows: Int[Tensor, "N 4"],
    settings: CyclesSettings,
    lights: Sequence[Light],
) -> list[Job]:
    """One job for every vehicle that the image may show.

    A crop also holds the other vehicles that reach into it, because they hide and shade each other.
    `ground` is the reflectance of the ground, `windows` come from `crop_windows`.
    """
    low, high = windows[:, :2], windows[:, 2:]
    template = {
        name: getattr(vehicles.template, name).cpu().numpy()
        for name in ("faces", "face_uvs", "uvs")
    }
    vertices = placed.vertices.detach().float().cpu().numpy()
    textures = _textures(vehicles)
    labels = material_labels(vehicles).cpu().numpy()
    materials = material_table(settings.finish).numpy()
    scene_of = placed.scene.cpu()
    jobs = []
    for index, scene in enumerate(scenes):
        irradiance, sky = daylight(scene.sun, *sky_light(lights[index], scene.weather.overcast))
        own = scene_of == index
        for number, row in enumerate(own.nonzero()[:, 0].tolist()):
            if not bool((high[row] > low[row]).all()):
                continue
            shared = own & ((low < high[row]) & (high > low[row])).all(1)
            left, top, right, bottom = windows[row].tolist()
            origin, patch = _patch(ground[index], (left, top, right, bottom), placed.gsd_m)
            numbers = {
                "window_px": [left, top, right - left, bottom - top],
                "size_px": placed.size_px,
                "gsd_m": placed.gsd_m,
                "viewer": list(scene.camera.direction),
                "sun": list(scene.sun.direction),
                "sun_irradiance": [
                    (1 - scene.placements[number].shade) * each for each in irradiance
                ],
                "sun_diameter_rad": _SUN_DIAMETER_RAD,
                "ground_origin_px": origin,
                "samples": settings.samples,
                # The seed is the same with and without camouflage, so that pairs share their noise.
                "seed": (scene.seed * 31 + number) % 2**31,
            }
            rows = shared.nonzero()[:, 0].tolist()
            arrays = {
                "sky": sky,
                "ground": patch,
                "materials": materials,
                **template,
                "vertices": vertices[rows],
                "textures": textures[[0] * len(rows) if len(textures) == 1 else rows],
                "labels": labels[rows],
            }
            name = f"vehicle {number + 1} of {scene.id}"
            jobs.append(Job(name, index, (left, top, right - left, bottom - top), numbers, arrays))
    return jobs


def _shown(srgb: Float[Tensor, "*S"]) -> np.ndarray:
    """Returns textures as bytes of their surfaces' reflectance."""
    return (linear_to_srgb(reflectance(srgb_to_linear(srgb))) * 255).round().byte().numpy()


def _textures(vehicles: VehicleBatch) -> np.ndarray:
    textures = vehicles.worn_texture().detach().cpu()
    if textures.dtype != torch.uint8:
        return _shown(textures.clamp(0, 1))
    # Each of the 256 values is computed once: a batch of full maps would take seconds.
    return np.take(_shown(torch.arange(256) / 255), textures.numpy())


def _patch(
    photograph: Float[Tensor, "3 H W"], window: tuple[int, int, int, int], gsd_m: float
) -> tuple[list[int], Float[np.ndarray, "h w 3"]]:
    """Returns the photograph around a window, at least one pixel, and its top-left pixel."""
    border = math.ceil(_GROUND_BORDER_M / gsd_m)
    size = photograph.shape[-1]
    left, top = (min(max(value - border, 0), size - 1) for value in window[:2])
    right, bottom = (value + border for value in window[2:])
    shown = photograph[:, top : max(bottom, top + 1), left : max(right, left + 1)]
    return [left, top], np.ascontiguousarray(shown.permute(1, 2, 0).float().cpu().numpy())
