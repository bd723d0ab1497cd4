"""A small rendered world that tests make: ground and vehicles of every split, and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.random_controls import RandomPatterns, wear_random_shapes
from skyproof.datasets.dataset import Dataset
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety

SIDE_PX = 96
TILES = {"train": 8, "validation": 3, "attack": 3, "test": 6}
TILE_PX = 200
VEHICLES = {"train": 30, "validation": 8, "attack": 8, "test": 10}
# Enough patterns that a short training learns them: with fewer, random ones hide two in three.
PAINTS = PaintVariety(plain=0.15, two_tone=0.05, livery=0.05, patterned=0.45)
BATCH = 16


@dataclass(frozen=True)
class RenderedWorld:
    """Ground and vehicles.

    Attributes:
        ground: tiles of every split.
        fleets: vehicles of every split; those that are trained on wear coats of every kind.
    """

    ground: BackgroundSet
    fleets: dict[str, Fleet]

    def renderer(self) -> TorchRenderer:
        """The renderer of all images here; a little coarser than the default, for speed."""
        return TorchRenderer(self.ground, RenderSettings(supersampling=3))

    def scenes(self, split: str, count: int, least: int, most: int) -> list[Scene]:
        """Scenes of a split, with so many vehicles each."""
        settings = SceneSettings(size_px=SIDE_PX, vehicles_minimum=least, vehicles_maximum=most)
        generator = torch.Generator().manual_seed(7)
        sizes_m = self.fleets[split].sizes_m
        return sample_scenes(settings, self.ground, split, sizes_m, count, generator=generator)

    @torch.no_grad()
    def images(
        self, split: str, scenes: list[Scene], camouflage: Camouflage | None = None
    ) -> Dataset:
        """Images as bytes, with the boxes in them."""
        images: list[Tensor] = []
        boxes: list[Tensor] = []
        for start in range(0, len(scenes), BATCH):
            batch = scenes[start : start + BATCH]
            worn = camouflage or RandomPatterns(self.fleets[split])
            frames = self.renderer()(batch, worn(placed_vehicles(self.fleets[split], batch)))
            images += list((frames.image * 255).round().byte())
            boxes += [frames.boxes[frames.scene_index == index] for index in range(len(batch))]
        return Dataset.of_images(images, boxes, gsd_m=0.125)


def make_world(folder: Path) -> RenderedWorld:
    """Draws ground and vehicles."""
    ground = write_procedural_backgrounds(folder / "ground", TILES, TILE_PX, seed=0)
    return RenderedWorld(ground, {split: _fleet(split) for split in TILES})


def _fleet(split: str) -> Fleet:
    generator = torch.Generator().manual_seed(list(TILES).index(split))
    paints = PAINTS if split in ("train", "validation") else CATALOGUE_PAINTS
    fleet = sample_fleet(FleetSettings(VEHICLES[split], paints=paints), generator=generator)
    return wear_random_shapes(fleet, generator=generator)
