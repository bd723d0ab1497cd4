"""Opens the renderer that a command's options choose."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skyproof.cycles.blender import find_blender
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import Rendering
from skyproof.cycles.workers import Workers
from skyproof.render.frames import Renderer
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.backgrounds import BackgroundSet


@contextmanager
def open_renderer(
    rendering: Rendering, backgrounds: BackgroundSet, out: Path
) -> Iterator[Renderer]:
    """Yields the chosen renderer; crops stay beside `out` until the block ends, for resuming.

    Raises:
        ConfigurationError: there is no usable Blender, or the settings cannot work.
    """
    if rendering.renderer == "torch":
        yield TorchRenderer(backgrounds)
        return
    crops = out.with_name(f".{out.name}.crops")
    with open_workers(rendering, crops) as workers:
        yield CyclesRenderer(backgrounds, workers, rendering.cycles)
    shutil.rmtree(crops, ignore_errors=True)


def open_workers(rendering: Rendering, results: Path | None = None) -> Workers:
    """Starts Blender's processes as a context, one per core by default."""
    count = _cores() if rendering.workers is None else rendering.workers
    return Workers(find_blender(rendering.blender), count, results)


def _cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
