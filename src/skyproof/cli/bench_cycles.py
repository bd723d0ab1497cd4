"""`skyproof bench --renderer cycles`: vehicle crops that Blender path-traces in an hour."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from skyproof.cli.bench_ground import BenchGround
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.render.dataset import render_dataset

_IMAGES = 64


def bench_cycles(
    folder: Path, image_px: int, workers: Workers, settings: CyclesSettings
) -> dict[str, Any]:
    """Returns figures of one dataset: crops, images and labels, once the processes have started.

    Args:
        folder: gets everything that is written.
        image_px: the side of an image in pixels.
        workers: Blender's processes.
        settings: how finely they draw.
    """
    ground = BenchGround(folder, image_px)
    scenes = ground.scenes(_IMAGES + workers.count, most=5)
    renderer = CyclesRenderer(ground.backgrounds, workers, settings)
    # This only wakes the processes. The scenes are others than the timed ones, so that none of
    # those is there already.
    render_dataset(folder / "start", scenes[_IMAGES:], ground.fleet, renderer)
    timed = scenes[:_IMAGES]
    vehicles = sum(len(scene.placements) for scene in timed)
    started = time.perf_counter()
    render_dataset(folder / "dataset", timed, ground.fleet, renderer)
    seconds = time.perf_counter() - started
    return {
        "blender": workers.blender.version,
        "samples": settings.samples,
        "workers": workers.count,
        "cores": os.cpu_count(),
        "image_px": image_px,
        "images": len(timed),
        "crops": vehicles,
        "seconds": round(seconds, 1),
        "crops_per_hour": round(3600 * vehicles / seconds),
        "worker_memory_mb": _largest_mb(map(_peak_memory_mb, workers.process_ids())),
    }


def _largest_mb(sizes: Iterable[float]) -> int | None:
    """Returns the largest; None where one is not known."""
    largest = max(sizes)
    return None if largest != largest else round(largest)


def _peak_memory_mb(process: int) -> float:
    """Returns the most memory that a process has held; nan where the system does not say."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(
        (float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), float("nan")
    )
