"""Which renderer a command draws with: options that several commands share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from skyproof.cycles.blender import find_blender
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.render.frames import Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet

__all__ = ["Rendering", "cycles_settings", "open_renderer", "open_workers"]


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """The differentiable renderer, or Blender's path tracer.

    Attributes:
        renderer: torch (the differentiable renderer) or cycles (Blender's path tracer).
        blender: for cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not given, what
            `make blender` made, then `blender` on the PATH.
        samples: for cycles: light paths per pixel; 32 in bulk, 64 for final pictures.
        finish: for cycles: camouflage paint under the vehicle's clear coat (gloss), or without (matt).
        workers: for cycles: Blender processes, of one thread each; one per CPU core where not given.
    """

    renderer: Literal["torch", "cycles"] = "torch"
    blender: Path | None = None
    samples: int = 32
    finish: Literal["gloss", "matt"] = "gloss"
    workers: int | None = None


@contextmanager
def open_renderer(
    rendering: Rendering, backgrounds: BackgroundSet, out: Path
) -> Iterator[Renderer]:
    """The renderer that was asked for.

    Path-traced crops are kept beside `out` until the block ends well: what was stopped goes on where it was.

    Raises:
        ConfigurationError: no usable Blender, or settings that cannot work.
    """
    sensor = RenderSettings.of(backgrounds.sensor)
    if rendering.renderer == "torch":
        yield TorchRenderer(backgrounds, sensor)
        return
    crops = out.with_name(f".{out.name}.crops")
    with open_workers(rendering, crops) as workers:
        yield CyclesRenderer(backgrounds, workers, cycles_settings(rendering), sensor)
    shutil.rmtree(crops, ignore_errors=True)


def open_workers(rendering: Rendering, results: Path | None = None) -> Workers:
    """Blender's processes, a context; one per core where their number is not given."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return Workers(
        find_blender(rendering.blender),
        cores if rendering.workers is None else rendering.workers,
        results,
    )


def cycles_settings(rendering: Rendering) -> CyclesSettings:
    """What the path tracer is told."""
    return CyclesSettings(samples=rendering.samples, finish=rendering.finish)
