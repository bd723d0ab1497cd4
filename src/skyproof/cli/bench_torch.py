"""`skyproof bench`: times the differentiable renderer, and attack steps beside detectors alone."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from skyproof import __version__
from skyproof.attacks.objective import frozen, objective_and_gradient
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.cli.bench_ground import BenchGround
from skyproof.detectors.build import build_detector
from skyproof.randomness import generator_of
from skyproof.render.dataset import placed_vehicles, render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.light import Light
from skyproof.scenes.scene import Scene
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.fleet import Fleet

_DATASET_IMAGES = 24
_ATTACKS = {
    "texture": "T-U",
    "fixed_colours": "T-Fc",
    "masked": "T-PixFcMa",
    "shape": "S-O@0.4",
    "texture_and_shape": "C-Fc-par@0.2",
}


def bench_torch(
    folder: Path,
    image_px: int,
    *,
    batch_size: int,
    repeats: int,
    detectors: Sequence[str],
    device: torch.device,
) -> dict[str, Any]:
    """Returns the machine and its figures: crops, a dataset, attack steps over detectors alone.

    Args:
        folder: gets everything that is written.
        image_px: the side of an image in pixels.
        batch_size: how many images a step has.
        repeats: how often everything is timed; the median counts.
        detectors: kinds of detectors, built slim and untrained.
        device: where everything runs.
    """
    ground = BenchGround(folder, image_px)
    renderer = TorchRenderer(ground.backgrounds)
    batch = ground.scenes(batch_size)

    # Crops are timed on one thread, as many attacks share a machine.
    threads = torch.get_num_threads()
    crops = _Crops(ground.fleet, device, batch)
    torch.set_num_threads(1)
    per_crop = {
        f"crop_64px_{name}_ms": round(1000 * _median(work, repeats, device) / batch_size, 2)
        for name, work in crops.work().items()
    }
    torch.set_num_threads(threads)

    many = ground.scenes(_DATASET_IMAGES, most=5)
    started = time.perf_counter()
    render_dataset(folder / "dataset", many, ground.fleet, renderer, device=device)
    images_per_second = round(len(many) / (time.perf_counter() - started), 1)

    return {
        "skyproof": __version__,
        "torch": torch.__version__,
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": str(device),
        "image_px": image_px,
        "batch_size": batch_size,
        **per_crop,
        "dataset_images_per_second": images_per_second,
        **_attack_steps(ground.fleet, renderer, batch, detectors, repeats, device),
    }


def _attack_steps(
    fleet: Fleet,
    renderer: TorchRenderer,
    batch: list[Scene],
    detectors: Sequence[str],
    repeats: int,
    device: torch.device,
) -> dict[str, float]:
    """Times attack steps and, in turn, the same step on ready-made images."""
    models = [build_detector(name, "slim", generator=generator_of(0, name)) for name in detectors]
    models = [model.to(device).to(memory_format=torch.channels_last) for model in models]
    palette = torch.rand(5, 3, generator=generator_of(0, "palette"))
    camouflages = {
        name: make_camouflage(recipe, palette=palette, generator=generator_of(0, "texture")).to(
            device
        )
        for name, recipe in _ATTACKS.items()
    }

    weights = {model.name: 1.0 for model in models}

    def detectors_only(images: torch.Tensor) -> torch.Tensor:
        return objective_and_gradient(models, weights, images)[1]

    def step(camouflage: Camouflage) -> None:
        vehicles = camouflage(placed_vehicles(fleet, batch).to(device))
        images = renderer(batch, vehicles).image
        images.backward(detectors_only(images))

    ratios: dict[str, list[float]] = {name: [] for name in camouflages}
    alone_s: list[float] = []
    with frozen(models):
        ready = renderer(batch, placed_vehicles(fleet, batch).to(device)).image
        for turn in range(repeats + 1):
            for name, camouflage in camouflages.items():
                step_s = _seconds(partial(step, camouflage), device)
                detectors_s = _seconds(partial(detectors_only, ready), device)
                # The first turn warms up.
                if turn:
                    ratios[name].append(step_s / detectors_s)
                    alone_s.append(detectors_s)
    figures = {"detectors_only_step_ms": round(1000 * statistics.median(alone_s), 1)}
    return figures | {
        f"{name}_step_over_detectors": round(statistics.median(values), 3)
        for name, values in ratios.items()
    }


class _Crops:
    """One vehicle on a 64 px image each, with its shadow: the crop that an attack step renders."""

    def __init__(self, fleet: Fleet, device: torch.device, scenes: list[Scene]) -> None:
        self.scenes = [
            replace(
                scene,
                camera=replace(scene.camera, size_px=64),
                placements=tuple(
                    replace(placement, x_m=0.0, y_m=0.0) for placement in scene.placements
                ),
            )
            for scene in scenes
        ]
        self.vehicles = placed_vehicles(fleet, self.scenes).to(device)
        self.texture = make_camouflage("T-U", generator=generator_of(0, "texture")).to(device)
        self.renderer = TorchRenderer(_Grey())

    def work(self) -> dict[str, Callable[[], None]]:
        """Returns what is timed, by name."""
        return {
            "forward": self._forward,
            "again": self._again,
            "texture": self._texture,
            "vertices": self._vertices,
        }

    @torch.no_grad()
    def _forward(self) -> None:
        # One that has drawn nothing yet: see `GeometryBuffers`.
        TorchRenderer(_Grey())(self.scenes, self.texture(self.vehicles))

    @torch.no_grad()
    def _again(self) -> None:
        """The same scenes as before, as in other textures."""
        self.renderer(self.scenes, self.texture(self.vehicles))

    def _texture(self) -> None:
        self.renderer(self.scenes, self.texture(self.vehicles)).image.sum().backward()

    def _vertices(self) -> None:
        moved = self.vehicles.vertices.clone().requires_grad_()
        painted = self.texture(replace(self.vehicles, vertices=moved))
        painted = replace(painted, texture=painted.texture.detach())
        self.renderer(self.scenes, painted).image.sum().backward()


class _Grey:
    """A photograph of nothing."""

    def window(self, window: object, size_px: int) -> torch.Tensor:
        return torch.full((3, size_px, size_px), 0.4)

    def light_of(self, window: object) -> Light:
        """A clear day."""
        return Light()

    def sensor_of(self, window: object) -> Sensor:
        return Sensor()

    def cover_of(self, window: object, size_px: int) -> None:
        return None


def _median(work: Callable[[], None], repeats: int, device: torch.device) -> float:
    work()
    return statistics.median(_seconds(work, device) for _ in range(repeats))


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize()
    started = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - started
