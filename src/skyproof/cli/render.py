"""`skyproof render`: a scene file drawn to images with labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from skyproof.cli.console import progress_bar, say
from skyproof.cycles.rendering import Rendering


@dataclass(frozen=True)
class Render(Rendering):
    """Draws a scene file to images with COCO labels, with or without a camouflage.

    With --renderer cycles the same scenes are path-traced in Blender, to the same labels.

    Attributes:
        scenes: scene file (JSON lines).
        backgrounds: background set folder.
        fleet: fleet folder.
        out: dataset folder to write.
        camouflage: camouflage folder; without one the vehicles stay as they are.
        labels: coco (annotations.json), or yolo to write YOLO text and data.yaml as well, as
            Ultralytics trains from.
        device: auto, cpu or cuda.
    """

    scenes: Path
    backgrounds: Path
    fleet: Path
    out: Path
    camouflage: Path | None = None
    labels: Literal["coco", "yolo"] = "coco"
    device: str = "auto"

    def run(self) -> None:
        """Draws the dataset."""
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.cli.device import choose_device
        from skyproof.cycles.opening import open_renderer
        from skyproof.render.dataset import render_dataset
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.scenes.scene import read_scenes
        from skyproof.vehicles.fleet import Fleet

        device = choose_device(self.device)
        with open_renderer(self, BackgroundSet.open(self.backgrounds), self.out) as renderer:
            scenes = read_scenes(self.scenes)
            fleet = Fleet.load(self.fleet)
            camouflage = load_camouflage(self.camouflage).to(device) if self.camouflage else None
            with progress_bar(f"render {self.out.name}") as update:
                render_dataset(
                    self.out,
                    scenes,
                    fleet,
                    renderer,
                    camouflage=camouflage,
                    yolo=self.labels == "yolo",
                    device=device,
                    progress=update,
                )
        say(f"Dataset: {self.out.resolve()}")
