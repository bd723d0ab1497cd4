"""Times the renderer, attack steps beside detectors alone, drawn ground, and Blender.

    python tools/bench.py
    python tools/bench.py --renderer cycles

It prints medians as JSON. Detectors are slim and untrained, which does not change the time. With
--renderer cycles it counts the vehicle crops that Blender path-traces in an hour.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro

from skyproof.attacks.attack import add_gradients
from skyproof.attacks.held_out import at_a_time
from skyproof.attacks.objective import frozen, objective_and_gradient
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import Rendering
from skyproof.cycles.workers import open_workers
from skyproof.detectors.loaded import build_detector
from skyproof.device import choose_device
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.randomness import generator_of
from skyproof.render.dataset import placed_vehicles, render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

_TILES = 4
_TILE_PX = 560
_IMAGES = 96
_CYCLES_IMAGES = 64
_ATTACKS = ("T-U", "T-Fc", "T-PixFcMa", "S-O@0.4", "C-Fc-par@0.2")


@dataclass(frozen=True)
class Bench(Rendering):
    """Times the renderer and attack steps, or Blender.

    Attributes:
        image_px: side of an image in pixels.
        batch_size: images of a step.
        repeats: how often everything is timed; the median counts.
        detectors: kinds of detectors that are attacked.
        device: auto, cpu or cuda.
    """

    image_px: int = 384
    batch_size: int = 8
    repeats: int = 7
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    device: str = "auto"


class _World:
    """Tiles and vehicles that are the same in every run."""

    def __init__(self, folder: Path, image_px: int) -> None:
        self.image_px = image_px
        started = time.perf_counter()
        self.backgrounds = write_procedural_backgrounds(
            folder / "tiles", {"attack": _TILES}, _TILE_PX, seed=0
        )
        self.tile_s = (time.perf_counter() - started) / _TILES
        self.fleet = sample_fleet(FleetSettings(count=16), generator=generator_of(0, "fleet"))

    def scenes(self, count: int, *, most: int = 1) -> list[Scene]:
        """Draws scenes of one vehicle, or of up to `most`."""
        return sample_scenes(
            SceneSettings(size_px=self.image_px, vehicles_maximum=most),
            self.backgrounds,
            "attack",
            self.fleet.sizes_m,
            count,
            generator=generator_of(0, "scenes"),
        )


def bench_torch(bench: Bench, folder: Path) -> dict[str, Any]:
    """Times crops, a dataset, and attack steps over detectors alone."""
    device = choose_device(bench.device)
    world = _World(folder, bench.image_px)
    batch = world.scenes(bench.batch_size)
    # Crops are timed on one thread, as many attacks share a machine.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    crops = _crops(bench, world, batch, device)
    torch.set_num_threads(threads)
    many = world.scenes(_IMAGES, most=5)
    renderer = TorchRenderer(world.backgrounds)
    started = time.perf_counter()
    render_dataset(folder / "dataset", many, world.fleet, renderer, device=device)
    images_s = time.perf_counter() - started
    return {
        "torch": torch.__version__,
        "threads": threads,
        "device": str(device),
        "batch_size": bench.batch_size,
        "tile_s": round(world.tile_s, 2),
        "images_per_second": round(_IMAGES / images_s, 1),
        **crops,
        **_attack_steps(bench, world, batch, device),
    }


def _crops(
    bench: Bench, world: _World, batch: list[Scene], device: torch.device
) -> dict[str, float]:
    """Times one vehicle with its shadow on 64 px, the crop that an attack step renders."""
    scenes = [
        replace(
            scene,
            camera=replace(scene.camera, size_px=64),
            placements=tuple(replace(place, x_m=0.0, y_m=0.0) for place in scene.placements),
        )
        for scene in batch
    ]
    vehicles = placed_vehicles(world.fleet, scenes).to(device)
    texture = make_camouflage("T-U", generator=generator_of(0, "texture")).to(device)
    renderer = TorchRenderer(world.backgrounds)

    @torch.no_grad()
    def forward() -> None:
        # A renderer that has drawn nothing yet: see `GeometryBuffers`.
        TorchRenderer(world.backgrounds)(scenes, texture(vehicles))

    @torch.no_grad()
    def again() -> None:
        renderer(scenes, texture(vehicles))

    def to_texture() -> None:
        renderer(scenes, texture(vehicles)).image.sum().backward()

    def to_vertices() -> None:
        moved = vehicles.vertices.clone().requires_grad_()
        painted = texture(replace(vehicles, vertices=moved))
        painted = replace(painted, texture=painted.texture.detach())
        renderer(scenes, painted).image.sum().backward()

    figures = {}
    for work in (forward, again, to_texture, to_vertices):
        work()
        median_s = statistics.median(_seconds(work, device) for _ in range(bench.repeats))
        figures[f"crop_{work.__name__}_ms"] = round(1000 * median_s / len(batch), 2)
    return figures


def _attack_steps(
    bench: Bench, world: _World, batch: list[Scene], device: torch.device
) -> dict[str, float]:
    """Times the gradients of attack steps and, in turn, the same on ready-made images."""
    models = [
        build_detector(name, "slim", generator=generator_of(0, name))
        .to(device)
        .to(memory_format=torch.channels_last)
        for name in bench.detectors
    ]
    weights = {model.name: 1.0 for model in models}
    palette = torch.rand(5, 3, generator=generator_of(0, "palette"))
    renderer = TorchRenderer(world.backgrounds)
    settings = SceneSettings(size_px=bench.image_px, vehicles_maximum=1)
    attacked = World(renderer, world.backgrounds, world.fleet, settings)

    def detectors_only(images: torch.Tensor) -> None:
        # In halves, as `add_gradients` has it.
        halves = images.chunk(2) if device.type == "cpu" else [images]
        share = 1 / len(halves)
        at_a_time(partial(objective_and_gradient, models, weights, share=share), halves, models)

    def step(camouflage: Camouflage) -> None:
        add_gradients(camouflage, models, weights, attacked, batch)
        camouflage.zero_grad()

    camouflages = {
        name: make_camouflage(name, palette=palette, generator=generator_of(0, "texture")).to(
            device
        )
        for name in _ATTACKS
    }
    ratios: dict[str, list[float]] = {name: [] for name in _ATTACKS}
    alone_s: list[float] = []
    with frozen(models):
        ready = renderer(batch, placed_vehicles(world.fleet, batch).to(device)).image
        for turn in range(bench.repeats + 1):
            for name, camouflage in camouflages.items():
                step_s = _seconds(partial(step, camouflage), device)
                detectors_s = _seconds(partial(detectors_only, ready), device)
                # The first turn warms up.
                if turn:
                    ratios[name].append(step_s / detectors_s)
                    alone_s.append(detectors_s)
    steps = {f"{name}_over_detectors": round(statistics.median(ratios[name]), 3) for name in ratios}
    return {"detectors_only_ms": round(1000 * statistics.median(alone_s), 1), **steps}


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    wait()
    started = time.perf_counter()
    work()
    wait()
    return time.perf_counter() - started


def bench_cycles(bench: Bench, folder: Path) -> dict[str, Any]:
    """Counts the crops, images and labels of one dataset that Blender draws in an hour."""
    with open_workers(bench) as workers:
        world = _World(folder, bench.image_px)
        scenes = world.scenes(_CYCLES_IMAGES + workers.count, most=5)
        renderer = CyclesRenderer(world.backgrounds, workers, bench.cycles)
        # Other scenes wake the processes, so that none of the timed ones is drawn already.
        render_dataset(folder / "start", scenes[_CYCLES_IMAGES:], world.fleet, renderer)
        timed = scenes[:_CYCLES_IMAGES]
        started = time.perf_counter()
        render_dataset(folder / "dataset", timed, world.fleet, renderer)
        seconds = time.perf_counter() - started
        vehicles = sum(len(scene.placements) for scene in timed)
        return {
            "blender": workers.blender.version,
            "samples": bench.cycles.samples,
            "workers": workers.count,
            "crops": vehicles,
            "crops_per_hour": round(3600 * vehicles / seconds),
            "worker_memory_mb": max(
                _peak_memory_mb(each.process.pid) for each in workers.processes if each.process
            ),
        }


def _peak_memory_mb(process: int) -> int:
    """Gives the most memory that a process of Linux ever held."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) // 1024 for line in lines if line.startswith("VmHWM"))


def main() -> None:
    bench = tyro.cli(Bench, description=__doc__)
    with tempfile.TemporaryDirectory() as folder:
        work = bench_cycles if bench.renderer == "cycles" else bench_torch
        print(json.dumps(work(bench, Path(folder)), indent=2))


if __name__ == "__main__":
    main()
