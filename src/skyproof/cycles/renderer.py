"""The path tracer as a renderer: the same scenes and labels in another light (section S3.2.2)."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.cycles.composite import composite_crops
from skyproof.cycles.jobs import crop_jobs, crop_windows
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.cover import covers, hidden
from skyproof.render.frames import Frames
from skyproof.render.lighting import scene_lights
from skyproof.render.placed import label, nothing_placed, place, visible_samples
from skyproof.render.renderer import (
    Backgrounds,
    photographed_lights,
    photographs,
    sensor_record,
    sensors,
)
from skyproof.render.settings import RenderSettings
from skyproof.render.weather import finish_images, wet_grounds
from skyproof.scenes.scene import Scene
from skyproof.vehicles.vehicle import VehicleBatch


class CyclesRenderer:
    """Path-traces a crop around every vehicle in Blender Cycles and lays it over the photograph.

    Sun and sky add up to the photograph's light. Vehicles hide, shade and mirror each other and
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
        """Its settings, with the blur and noise of these scenes, and Blender's version."""
        # Settings of the differentiable renderer alone make no difference here, and the ground's
        # own light is the ground's.
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
        ground = wet_grounds(
            photographs(self.backgrounds, scenes, vehicles.vertices.device), scenes
        )
        if not len(vehicles):
            return nothing_placed(finish_images(ground, scenes), masks=masks)
        placed = place(scenes, vehicles)
        shown_by = sensors(self.backgrounds, scenes, self.shared)
        shown = photographed_lights(self.backgrounds, scenes, self.shared)
        lights = scene_lights(shown, scenes, ground)
        margin_px = math.ceil(self.settings.margin_m / placed.gsd_m)
        windows = crop_windows(placed, margin_px, [sensor.blur_radius_px for sensor in shown_by])
        jobs = crop_jobs(
            scenes,
            vehicles,
            placed,
            lights.received(srgb_to_linear(ground)),
            windows,
            self.settings,
            shown,
        )
        drawn = [
            torch.from_numpy(crop).permute(2, 0, 1).to(ground) for crop in self.workers.run(jobs)
        ]
        images: list[Float[Tensor, "3 H W"]] = []
        for index, scene in enumerate(scenes):
            crops = [
                (job.window_px, layers)
                for job, layers in zip(jobs, drawn, strict=True)
                if job.scene == index
            ]
            images.append(
                composite_crops(
                    ground[index],
                    crops,
                    scene.seed,
                    margin_px,
                    shown_by[index],
                    lights.of(index),
                )
            )
        image = torch.stack(images)
        cover = covers(self.backgrounds.cover_of, scenes, placed, vehicles.template.faces)
        if cover is not None:
            image = hidden(image, ground, cover)
        finished = finish_images(image, scenes)
        factor = self.shared.supersampling
        visibility, window = visible_samples(placed, vehicles.template.faces, factor)
        return label(finished, placed, visibility, window, factor, cover=cover, masks=masks)
