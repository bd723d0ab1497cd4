"""Measures whether vehicles that shade themselves look more as path tracing has them.

    skyproof render --renderer cycles --scenes RUN/scenes/test.jsonl --out CYCLES \\
        --backgrounds RUN/backgrounds --fleet RUN/fleets/test --camouflage RUN/camouflages/NAME
    python tools/compare_self_shadows.py --run-folder RUN --camouflage NAME --cycles CYCLES \\
        --out docs/results/cycles/self_shadows.json

Drawn once without and once with `RenderSettings.self_shadows`, and compared with Cycles pixel by
pixel, within the vehicles' boxes and where the two drawings differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.camouflage.folder import load_camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.files import write_json
from skyproof.geometry.colour import srgb_to_linear
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import read_scenes
from skyproof.vehicles.fleet import Fleet

BATCH = 8
# Levels of 255 by which a pixel has to differ to count as changed.
CHANGED = 5.0

# Without self-shadows, with them, by Cycles; each of the image's pixels.
_Images = tuple[Float[Tensor, "3 H W"], Float[Tensor, "3 H W"], Float[Tensor, "3 H W"]]


@dataclass(frozen=True)
class CompareSelfShadows:
    """Compares both ways of drawing with a dataset by Cycles.

    Attributes:
        run_folder: holds backgrounds, fleets/test and scenes/test.jsonl.
        cycles: dataset of the same scenes by Cycles, in the same camouflage.
        out: JSON file to write.
        camouflage: its folder's name in the run; without one the vehicles stay as they are.
    """

    run_folder: Path
    cycles: Path
    out: Path
    camouflage: str | None = None

    def run(self) -> None:
        """Measures, writes, prints."""
        inside, changed = [], []
        for images, boxes in self._images():
            stacked = torch.stack(images) * 255
            differs = (stacked[0] - stacked[1]).abs().amax(0) > CHANGED
            inside.append(stacked[:, :, boxes])
            changed.append(stacked[:, :, boxes & differs])
        inside_boxes, where_changed = torch.cat(inside, dim=2), torch.cat(changed, dim=2)
        figures = {
            "camouflage": self.camouflage,
            "changed_share": where_changed.shape[2] / inside_boxes.shape[2],
            "within_boxes": _closeness(inside_boxes),
            "where_changed": _closeness(where_changed),
        }
        write_json(self.out, figures)
        print(figures)

    @torch.no_grad()
    def _images(self) -> Iterator[tuple[_Images, Bool[Tensor, "H W"]]]:
        """Yields every scene three times, and the pixels of its vehicles' boxes."""
        scenes = read_scenes(self.run_folder / "scenes/test.jsonl")
        theirs = Dataset.open(self.cycles)
        if theirs.scenes != scenes:
            raise ConfigurationError(f"{self.cycles} does not show the scenes of the run.")
        backgrounds = BackgroundSet.open(self.run_folder / "backgrounds")
        fleet = Fleet.load(self.run_folder / "fleets/test")
        worn = None
        if self.camouflage is not None:
            worn = load_camouflage(self.run_folder / "camouflages" / self.camouflage)
        without, shading = (
            TorchRenderer(backgrounds, RenderSettings(self_shadows=shades))
            for shades in (False, True)
        )
        for start in range(0, len(scenes), BATCH):
            batch = scenes[start : start + BATCH]
            vehicles = placed_vehicles(fleet, batch)
            if worn is not None:
                vehicles = worn(vehicles)
            plain, shaded = without(batch, vehicles), shading(batch, vehicles)
            for index in range(len(batch)):
                cycles = theirs.image(start + index).float() / 255
                boxes = torch.zeros(cycles.shape[1:], dtype=torch.bool)
                for row in plain.boxes[plain.scene_index == index].tolist():
                    left, top, right, bottom = (int(value) for value in row)
                    boxes[top : bottom + 1, left : right + 1] = True
                yield (plain.image[index], shaded.image[index], cycles), boxes


def _closeness(images: Float[Tensor, "3 3 K"]) -> dict[str, dict[str, float]]:
    """How far both drawings are from Cycles, in levels of 255, and how bright."""
    cycles = images[2]
    figures = {}
    for name, drawn in (("without", images[0]), ("with", images[1])):
        difference = drawn - cycles
        light = srgb_to_linear(cycles / 255).mean() / srgb_to_linear(drawn / 255).mean()
        figures[name] = {
            "mean_absolute_difference": round(float(difference.abs().mean()), 2),
            "root_mean_square": round(float(difference.square().mean().sqrt()), 2),
            "light_of_cycles_over_it": round(float(light), 3),
        }
    return figures


if __name__ == "__main__":
    tyro.cli(CompareSelfShadows).run()
