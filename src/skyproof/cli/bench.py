"""`skyproof bench`: how fast rendering is, and what it costs an attack."""

from __future__ import annotations

import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from skyproof import __version__
from skyproof.attacks.objective import empty_truth_losses, frozen
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.recipe import Materials, make_camouflage, read_recipe
from skyproof.camouflage.texture import UniversalTexture
from skyproof.cli.bench_cycles import bench_cycles
from skyproof.cli.console import say
from skyproof.cli.rendering import Rendering, cycles_settings, open_workers
from skyproof.cli.stages import choose_device, generator_of
from skyproof.detectors.build import build_detector
from skyproof.files import write_json
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles, render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

__all__ = ["Bench"]

_TILE_PX = 560
_CYCLES_IMAGES = 64
_ATTACKS = {
    "texture": "T-U",
    "fixed_colours": "T-Fc",
    "masked": "T-PixFcMa",
    "shape": "S-O@0.4",
    "texture_and_shape": "C-Fc-par@0.2",
}


@dataclass(frozen=True)
class Bench(Rendering):
    """Times the renderer and the attack step on 384 px images, and prints medians.

    With --renderer cycles it times Blender instead: vehicle crops per hour, and memory per process.

    Attributes:
        json: file to write the figures to.
        image_px: image side.
        batch_size: images a step.
        repeats: timed repetitions; the median counts.
        detectors: the slim ensemble of the attack step; weights are untrained, which does not change the time.
        device: auto, cpu or cuda.
    """

    json: Path | None = None
    image_px: int = 384
    batch_size: int = 8
    repeats: int = 7
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    device: str = "auto"

    def run(self) -> None:
        """Measures, prints, writes."""
        device = choose_device(self.device)
        with tempfile.TemporaryDirectory() as folder:
            cycles = self.renderer == "cycles"
            figures = self._cycles(Path(folder)) if cycles else self._measure(Path(folder), device)
        for name, value in figures.items():
            say(f"  {name}: {value}")
        if self.json:
            write_json(self.json, figures)

    def _world(self, folder: Path) -> tuple[BackgroundSet, Fleet, Callable[..., list[Scene]]]:
        backgrounds = write_procedural_backgrounds(
            folder / "tiles", {"attack": 4}, _TILE_PX, seed=0
        )
        fleet = sample_fleet(FleetSettings(count=16), generator=generator_of(0, "fleet"))
        settings = SceneSettings(size_px=self.image_px, vehicles_maximum=1)

        def scenes(count: int, most: int = 1) -> list[Scene]:
            chosen = replace(settings, vehicles_maximum=most)
            return sample_scenes(
                chosen,
                backgrounds,
                "attack",
                fleet.sizes_m,
                count,
                generator=generator_of(0, "scenes"),
            )

        return backgrounds, fleet, scenes

    def _cycles(self, folder: Path) -> dict[str, Any]:
        backgrounds, fleet, scenes = self._world(folder)
        with open_workers(self) as workers:
            many = scenes(_CYCLES_IMAGES + workers.count, most=5)
            return bench_cycles(folder, many, fleet, backgrounds, workers, cycles_settings(self))

    def _measure(self, folder: Path, device: torch.device) -> dict[str, Any]:
        backgrounds, fleet, scenes = self._world(folder)
        renderer = TorchRenderer(backgrounds)
        threads = torch.get_num_threads()
        crops = _Crops(fleet, device, scenes(self.batch_size))
        torch.set_num_threads(1)
        per_crop = {
            f"crop_64px_{name}_ms": round(1000 * self._median(work, device) / self.batch_size, 2)
            for name, work in crops.work().items()
        }
        torch.set_num_threads(threads)

        many = scenes(24, most=5)
        started = time.perf_counter()
        render_dataset(folder / "dataset", many, fleet, renderer, device=device)
        images_per_second = round(len(many) / (time.perf_counter() - started), 1)

        ratios = self._attack_steps(fleet, renderer, scenes(self.batch_size), device)
        return {
            "skyproof": __version__,
            "torch": torch.__version__,
            "machine": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "threads": threads,
            "device": str(device),
            "image_px": self.image_px,
            "batch_size": self.batch_size,
            **per_crop,
            "dataset_images_per_second": images_per_second,
            **ratios,
        }

    def _attack_steps(
        self, fleet: Fleet, renderer: TorchRenderer, batch: list[Scene], device: torch.device
    ) -> dict[str, float]:
        """Attack steps on some camouflages, and the same step on ready-made images; taken in turn."""
        models = [
            build_detector(name, "slim", generator=generator_of(0, name)) for name in self.detectors
        ]
        models = [model.to(device).to(memory_format=torch.channels_last) for model in models]
        palette = torch.rand(5, 3, generator=generator_of(0, "palette"))
        camouflages = {
            name: make_camouflage(
                read_recipe(recipe), Materials(palette), generator=generator_of(0, "texture")
            ).to(device)
            for name, recipe in _ATTACKS.items()
        }

        def detectors_only(images: torch.Tensor) -> torch.Tensor:
            leaf = images.detach().contiguous(memory_format=torch.channels_last).requires_grad_()
            for model in models:
                empty_truth_losses([model], leaf)[model.name].mean().backward()
            assert leaf.grad is not None
            return leaf.grad

        def step(camouflage: Camouflage) -> None:
            vehicles = camouflage(placed_vehicles(fleet, batch).to(device))
            images = renderer(batch, vehicles).image
            images.backward(detectors_only(images))

        ratios: dict[str, list[float]] = {name: [] for name in camouflages}
        alone: list[float] = []
        with frozen(models):
            ready = renderer(batch, placed_vehicles(fleet, batch).to(device)).image
            for turn in range(self.repeats + 1):
                for name, camouflage in camouflages.items():
                    pair = (
                        _seconds(partial(step, camouflage), device),
                        _seconds(partial(detectors_only, ready), device),
                    )
                    if turn:
                        ratios[name].append(pair[0] / pair[1])
                        alone.append(pair[1])
        found = {"detectors_only_step_ms": round(1000 * statistics.median(alone), 1)}
        return found | {
            f"{name}_step_over_detectors": round(statistics.median(r), 3)
            for name, r in ratios.items()
        }

    def _median(self, work: Callable[[], None], device: torch.device) -> float:
        work()
        return statistics.median(_seconds(work, device) for _ in range(self.repeats))


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
        self.texture = UniversalTexture("T-U", generator=generator_of(0, "texture")).to(device)
        self.renderer = TorchRenderer(_Grey())

    def work(self) -> dict[str, Callable[[], None]]:
        """What is timed, by name."""
        return {"forward": self._forward, "texture": self._texture, "vertices": self._vertices}

    @torch.no_grad()
    def _forward(self) -> None:
        self.renderer(self.scenes, self.texture(self.vehicles))

    def _texture(self) -> None:
        self.renderer(self.scenes, self.texture(self.vehicles)).image.sum().backward()

    def _vertices(self) -> None:
        moved = self.vehicles.vertices.clone().requires_grad_()
        worn = self.texture(replace(self.vehicles, vertices=moved))
        self.renderer(
            self.scenes, replace(worn, texture=worn.texture.detach())
        ).image.sum().backward()


class _Grey:
    def window(self, window: object, size_px: int) -> torch.Tensor:
        return torch.full((3, size_px, size_px), 0.4)


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize()
    started = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - started
