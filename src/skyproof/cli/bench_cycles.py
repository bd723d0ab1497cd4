"""`skyproof bench --renderer cycles`: how many vehicle crops Blender path-traces in an hour, and in what memory."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.render.dataset import render_dataset
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet

__all__ = ["bench_cycles"]


def bench_cycles(
    folder: Path,
    scenes: Sequence[Scene],
    fleet: Fleet,
    backgrounds: BackgroundSet,
    workers: Workers,
    settings: CyclesSettings,
) -> dict[str, Any]:
    """Figures of one dataset written after the processes have started: crops, images and labels all included."""
    renderer = CyclesRenderer(backgrounds, workers, settings)
    # Other scenes than are timed, so that none of those is there already; this only wakes the processes.
    render_dataset(folder / "start", scenes[-workers.count :], fleet, renderer)
    timed = scenes[: -workers.count]
    vehicles = sum(len(scene.placements) for scene in timed)
    started = time.perf_counter()
    render_dataset(folder / "dataset", timed, fleet, renderer)
    seconds = time.perf_counter() - started
    return {
        "blender": workers.blender.version,
        "samples": settings.samples,
        "workers": workers.count,
        "cores": os.cpu_count(),
        "image_px": timed[0].camera.size_px,
        "images": len(timed),
        "crops": vehicles,
        "seconds": round(seconds, 1),
        "crops_per_hour": round(3600 * vehicles / seconds),
        "worker_memory_mb": round(max(map(_peak_memory_mb, workers.process_ids()))),
    }


def _peak_memory_mb(process: int) -> float:
    """The most that a process has held; nan where the system does not say."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(
        (float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), float("nan")
    )
