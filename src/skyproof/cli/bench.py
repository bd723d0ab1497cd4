"""`skyproof bench`: how fast rendering is, and what it costs an attack."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from skyproof.cli.console import say
from skyproof.cli.rendering import Rendering
from skyproof.files import new_file, refuse_existing, write_json


@dataclass(frozen=True)
class Bench(Rendering):
    """Times the renderer and the attack step on 384 px images, and prints medians.

    With --renderer cycles it times Blender instead: vehicle crops per hour, and memory per process.

    Attributes:
        json: new file to write the figures to.
        image_px: the side of an image in pixels.
        batch_size: how many images a step has.
        repeats: how often everything is timed; the median counts.
        detectors: the slim ensemble of the attack step; its weights are untrained, which does not
            change the time.
        device: auto, cpu or cuda.
    """

    json: Path | None = None
    image_px: Annotated[int, Meta(ge=64, le=4096)] = 384
    batch_size: Annotated[int, Meta(ge=1, le=10_000)] = 8
    repeats: Annotated[int, Meta(ge=1, le=10_000)] = 7
    detectors: tuple[str, ...] = ("retinanet", "faster_rcnn", "yolov5")
    device: str = "auto"

    def run(self) -> None:
        """Measures, prints and writes the figures."""
        from skyproof.cli.bench_cycles import bench_cycles
        from skyproof.cli.bench_torch import bench_torch
        from skyproof.cli.device import choose_device
        from skyproof.cli.renderers import open_workers

        if self.json is not None:
            # Known before an hour's work, not after it.
            refuse_existing(self.json)
        device = choose_device(self.device)
        with tempfile.TemporaryDirectory() as folder:
            if self.renderer == "cycles":
                with open_workers(self) as workers:
                    figures = bench_cycles(Path(folder), self.image_px, workers, self.cycles)
            else:
                figures = bench_torch(
                    Path(folder),
                    self.image_px,
                    batch_size=self.batch_size,
                    repeats=self.repeats,
                    detectors=self.detectors,
                    device=device,
                )
        for name, value in figures.items():
            say(f"  {name}: {value}")
        if self.json is not None:
            with new_file(self.json):
                write_json(self.json, figures)
