"""The path tracer as a renderer: the same scenes and labels in another light (section S3.2.2)."""

import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from skyproof.cycles.jobs import crop_jobs, crop_windows
from skyproof.cycles.settings import CyclesSettings, Rendering
from skyproof.cycles.workers import Workers, open_workers
from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.render.composite import covers, hidden
from skyproof.render.frames import Frames, Renderer
from skyproof.render.lighting import SceneLights, scene_lights
from skyproof.render.placed import coverage_of, label, nothing_placed, place
from skyproof.render.renderer import (
    Backgrounds,
    TorchRenderer,
    photographed_lights,
    photographs,
    sensor_record,
    sensors,
)
from skyproof.render.sensor import blur_weights, noise_tiles
from skyproof.render.settings import RenderSettings
from skyproof.render.weather import finish_images, wet_grounds
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.vehicle import VehicleBatch

_LEAST_WEIGHT = 1e-3
_Crop = tuple[tuple[int, int, int, int], Float[Tensor, "7 _h _w"]]


class CyclesRenderer:
    """Path-traces a crop around every vehicle in Blender Cycles and lays it over the photograph.

    Sun and sky add up to the photograph's light. Vehicles hide, shade and reflect each other and
    themselves, and exchange light with the photographed ground. Camera, places, labels, blur, noise
    and weather are those of `TorchRenderer`.

    Differences from the paper: only crops are path-traced, and the photograph is the ground,
    because the authors' Blender scenes are not available. Vehicles are closed shells.
    """

    name = "cycles"
    differentiable = False
    # Its processes already run in parallel.
    concurrent = False

    def __init__(
        self,
        backgrounds: Backgrounds,
        workers: Workers,
        settings: CyclesSettings | None = None,
        shared: RenderSettings | None = None,
    ) -> None:
        self.backgrounds, self.workers = backgrounds, workers
        self.settings = settings or CyclesSettings()
        self.shared = shared or RenderSettings()

    def record(self, scenes: Sequence[Scene]) -> dict[str, Any]:
        """Returns the settings, the blur and noise of these scenes, and Blender's version."""
        # Settings that only the differentiable renderer uses make no difference here, and the
        # ground's own light belongs to the ground.
        given = {} if self.shared.light is None else {"light": asdict(self.shared.light)}
        return {
            **given,
            **asdict(self.settings),
            **sensor_record(self.backgrounds, scenes, self.shared),
            "blender": self.workers.blender.version,
        }

    @torch.no_grad()
    def __call__(
        self, scenes: Sequence[Scene], vehicles: VehicleBatch, *, masks: bool = False
    ) -> Frames:
        """Draws one image per scene; arguments as for `TorchRenderer`.

        Raises:
            RunFolderError: Blender failed twice at a crop, or the disk is full.
        """
        photographed = photographs(self.backgrounds, scenes, vehicles.vertices.device)
        ground = wet_grounds(photographed, scenes)
        if not len(vehicles):
            return nothing_placed(finish_images(ground, scenes), masks=masks)
        placed = place(scenes, vehicles)
        shown_by = sensors(self.backgrounds, scenes, self.shared)
        shown = photographed_lights(self.backgrounds, scenes, self.shared)
        lights = scene_lights(shown, scenes, ground)
        margin_px = math.ceil(self.settings.margin_m / placed.gsd_m)
        windows = crop_windows(placed, margin_px, [sensor.blur_radius_px for sensor in shown_by])
        light = lights.received(srgb_to_linear(ground))
        jobs = crop_jobs(scenes, vehicles, placed, light, windows, self.settings, shown)
        crops: list[list[_Crop]] = [[] for _ in scenes]
        for job, drawn in zip(jobs, self.workers.run(jobs), strict=True):
            layers = torch.from_numpy(drawn).permute(2, 0, 1).to(ground)
            crops[job.scene].append((job.window_px, layers))
        images = [
            composite_crops(ground[i], crops[i], scene.seed, margin_px, shown_by[i], lights.of(i))
            for i, scene in enumerate(scenes)
        ]
        image = torch.stack(images)
        cover = covers(self.backgrounds.cover_of, scenes, placed, vehicles.template.faces)
        if cover is not None:
            image = hidden(image, ground, cover)
        finished = finish_images(image, scenes)
        factor = self.shared.supersampling
        coverage, window = coverage_of(placed, vehicles.template.faces, factor)
        return label(finished, placed, coverage, window, cover=cover, masks=masks)


@contextmanager
def open_renderer(
    rendering: Rendering, backgrounds: BackgroundSet, out: Path
) -> Iterator[Renderer]:
    """Yields the chosen renderer; crops stay beside `out` until the block ends, for resuming."""
    if rendering.renderer == "torch":
        yield TorchRenderer(backgrounds)
        return
    crops = out.with_name(f".{out.name}.crops")
    with open_workers(rendering, crops) as workers:
        yield CyclesRenderer(backgrounds, workers, rendering.cycles)
    shutil.rmtree(crops, ignore_errors=True)


@torch.no_grad()
def composite_crops(
    photograph: Float[Tensor, "3 H W"],
    crops: Sequence[_Crop],
    seed: int,
    margin_px: int,
    sensor: Sensor,
    lights: SceneLights,
) -> Float[Tensor, "3 H W"]:
    """Lays crops over one image in linear light (section S2): I_bg * (1 - G(taken)) + G(colour).

    `taken` is the share of the ground's light that a crop takes per channel: all behind vehicles,
    and 1 - ratio beside them, where ratio is the light there over the light without vehicles.
    Pixels out of reach keep the photograph's value exactly. Vehicles get the sensor's noise.

    A crop is a window (left, top, width, height in image pixels) and linear colour times coverage
    (3), coverage (1), ratio (3). It shows everything there, so any crop is right in an overlap.
    Within the margin the ratio fades out towards a crop's edge, but not at the image's border,
    where the shadow continues.
    """
    if not crops:
        return photograph
    radius, size = sensor.blur_radius_px, photograph.shape[-1]
    wide, limits = size + 2 * radius, (-radius, size + radius)
    total = photograph.new_zeros(7, wide, wide)
    weight = photograph.new_zeros(wide, wide)
    nearest = photograph.new_zeros(wide, wide)
    for (left, top, width, height), layers in crops:
        rows = slice(top + radius, top + radius + height)
        columns = slice(left + radius, left + radius + width)
        vertical = _inwards(top, height, limits, margin_px, layers)
        inside = vertical[:, None] * _inwards(left, width, limits, margin_px, layers)
        trust = inside + _LEAST_WEIGHT
        total[:, rows, columns] += layers * trust
        weight[rows, columns] += trust
        nearest[rows, columns] = torch.maximum(nearest[rows, columns], inside)
    mean = total / weight.clamp(min=_LEAST_WEIGHT)
    colour, alpha, ratio = mean.split((3, 1, 3))
    taken = alpha + (1 - alpha) * (1 - ratio) * nearest * (weight > 0)
    colour, alpha, taken = (_blurred(layer, sensor) for layer in (colour, alpha, taken))
    ground = lights.received(srgb_to_linear(photograph)[None])
    mixed = (ground * (1 - taken) + colour).clamp(min=0.0)
    pixels = linear_to_srgb(lights.shown(mixed))[0]
    if sensor.noise > 0:
        tile = noise_tiles([seed])[0].to(pixels)
        noise = tile.repeat(1, *[math.ceil(size / len(tile[0]))] * 2)[:, :size, :size]
        pixels = pixels + sensor.noise * alpha * noise
    reached = (taken != 0).any(0) | (alpha[0] > 0)
    return torch.where(reached, pixels.clamp(0.0, 1.0), photograph)


def _inwards(
    first: int, length: int, limits: tuple[int, int], margin: int, like: Tensor
) -> Float[Tensor, " length"]:
    """Returns weights that rise to 1 over the margin from 0 at each end within the limits."""
    step = torch.arange(length, device=like.device, dtype=like.dtype) + 0.5
    endless = torch.full_like(step, torch.inf)
    from_first = step if first > limits[0] else endless
    from_last = length - step if first + length < limits[1] else endless
    return (torch.minimum(from_first, from_last) / max(margin, 1)).clamp(max=1.0)


def _blurred(picture: Float[Tensor, "C S S"], sensor: Sensor) -> Float[Tensor, "C s s"]:
    """Returns a picture under its sensor's Gaussian blur, without a rim as wide as its reach."""
    half = blur_weights([sensor], sensor.blur_radius_px, picture)[0]
    kernel = torch.cat((half[1:].flip(0), half))
    down = F.conv2d(picture[:, None], kernel.view(1, 1, -1, 1))
    return F.conv2d(down, kernel.view(1, 1, 1, -1))[:, 0]
