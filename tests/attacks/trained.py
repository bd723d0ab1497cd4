"""A small world with two slim detectors that were trained in it, and what attacks on them reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from skyproof.attacks.attack import attack
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.random_controls import wear_random_controls
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.build import build_detector
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.matching import match_images
from skyproof.detectors.settings import TrainingSettings
from skyproof.detectors.training import train
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
TRAINING_IMAGES, VALIDATION_IMAGES, TEST_SCENES = 240, 40, 80
TILES = {"train": 8, "validation": 3, "attack": 3, "test": 6}
TILE_PX = 200
VEHICLES = {"train": 30, "validation": 8, "attack": 8, "test": 10}
# Focal loss starts slowly.
STEPS = {"retinanet": 240, "faster_rcnn": 220}
BATCH = 16
# Enough patterns that so short a training learns them: with fewer, random ones hide two in three.
PAINTS = PaintVariety(plain=0.15, two_tone=0.05, livery=0.05, patterned=0.45)
ATTACK = AttackSettings(
    steps=25, batch_size=8, balance_batches=2, preview_every=1000, checkpoint_every=1000
)
SHAPE_STEPS = 60

Found = dict[str, Tensor]
"""Per detector whether it finds the vehicle of each test scene, `[TEST_SCENES]` bool."""


@dataclass(frozen=True)
class Trained:
    """Detectors in their world.

    Attributes:
        ground: tiles of every split.
        fleets: vehicles of every split; those that are trained on wear coats of every kind.
        detectors: RetinaNet and Faster R-CNN, slim, trained.
        thresholds: frozen, by name.
        test: scenes with one vehicle each, on ground and of vehicles that nothing was learnt on.
        clean: which of them are found without camouflage.
    """

    ground: BackgroundSet
    fleets: dict[str, Fleet]
    detectors: list[TrainableDetector]
    thresholds: dict[str, float]
    test: list[Scene]
    clean: Found

    def learn(
        self, name: str, folder: Path, against: list[TrainableDetector] | None = None
    ) -> Camouflage:
        """Learns a camouflage, against both detectors where none is named."""
        scenes = SceneSettings(size_px=SIDE_PX, vehicles_maximum=1)
        world = AttackWorld(_renderer(self.ground), self.ground, self.fleets["attack"], scenes)
        camouflage = drawn(name)
        settings = ATTACK
        if camouflage.name.kind == "shape":
            settings = replace(ATTACK, steps=SHAPE_STEPS)
        return attack(camouflage, against or self.detectors, world, settings, folder)

    def success(self, camouflage: Camouflage) -> dict[str, float]:
        """The share of the vehicles found before that each detector loses."""
        images, boxes = self.rendered(camouflage, self.test)
        after = _found(self.detectors, self.thresholds, _dataset(images, boxes))
        return {
            name: float((before & ~after[name]).sum() / before.sum())
            for name, before in self.clean.items()
        }

    def rendered(
        self, camouflage: Camouflage | None, scenes: list[Scene]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Images as bytes and the boxes in them."""
        return render(self.ground, self.fleets["test"], scenes, camouflage)


def drawn(name: str, seed: int = 0) -> Camouflage:
    """A camouflage as it starts; of a random one, as it is."""
    return make_camouflage(name, generator=torch.Generator().manual_seed(seed))


def make_trained(folder: Path) -> Trained:
    """Draws ground and vehicles, renders images, and trains both detectors on them."""
    ground = write_procedural_backgrounds(folder / "ground", TILES, TILE_PX, seed=0)
    fleets = {split: _fleet(split) for split in TILES}
    training, validation = (
        _dataset(*render(ground, fleets[split], _scenes(ground, fleets, split, count, least, 4)))
        for split, count, least in (
            ("train", TRAINING_IMAGES, 0),
            ("validation", VALIDATION_IMAGES, 1),
        )
    )
    detectors, thresholds = [], {}
    for name, steps in STEPS.items():
        generator = torch.Generator().manual_seed(0)
        detector = build_detector(name, "slim", generator=generator)
        settings = TrainingSettings(
            steps=steps, batch_size=8, validate_every=steps, checkpoint_every=steps
        )
        card = train(detector, training, validation, settings, folder / name, generator=generator)
        detectors.append(detector.eval().requires_grad_(False))
        thresholds[name] = card.threshold
    test = _scenes(ground, fleets, "test", TEST_SCENES, 1, 1)
    clean = _found(detectors, thresholds, _dataset(*render(ground, fleets["test"], test)))
    return Trained(ground, fleets, detectors, thresholds, test, clean)


@torch.no_grad()
def render(
    ground: BackgroundSet, fleet: Fleet, scenes: list[Scene], camouflage: Camouflage | None = None
) -> tuple[list[Tensor], list[Tensor]]:
    """Images as bytes and the boxes in them."""
    images: list[Tensor] = []
    boxes: list[Tensor] = []
    for start in range(0, len(scenes), BATCH):
        batch = scenes[start : start + BATCH]
        vehicles = placed_vehicles(fleet, batch)
        frames = _renderer(ground)(batch, camouflage(vehicles) if camouflage else vehicles)
        images += list((frames.image * 255).round().byte())
        boxes += [frames.boxes[frames.scene_index == index] for index in range(len(batch))]
    return images, boxes


def _renderer(ground: BackgroundSet) -> TorchRenderer:
    return TorchRenderer(ground, RenderSettings(supersampling=3))


def _fleet(split: str) -> Fleet:
    generator = torch.Generator().manual_seed(list(TILES).index(split))
    paints = PAINTS if split in ("train", "validation") else CATALOGUE_PAINTS
    fleet = sample_fleet(FleetSettings(VEHICLES[split], paints=paints), generator=generator)
    return wear_random_controls(fleet, generator=generator)


def _scenes(
    ground: BackgroundSet, fleets: dict[str, Fleet], split: str, count: int, least: int, most: int
) -> list[Scene]:
    settings = SceneSettings(size_px=SIDE_PX, vehicles_minimum=least, vehicles_maximum=most)
    generator = torch.Generator().manual_seed(7)
    return sample_scenes(settings, ground, split, fleets[split].sizes_m, count, generator=generator)


def _dataset(images: list[Tensor], boxes: list[Tensor]) -> Dataset:
    return Dataset.of_images(images, boxes, gsd_m=0.125)


def _found(
    detectors: list[TrainableDetector], thresholds: dict[str, float], images: Dataset
) -> Found:
    """One vehicle an image, so that vehicles and images are numbered alike."""
    found = {}
    for detector in detectors:
        table = match_images(detect_all(detector, images), images, criterion="centre_1m")
        reached = torch.from_numpy(table.found_at(thresholds[detector.name]))
        found[detector.name] = torch.zeros(len(images), dtype=torch.bool)
        found[detector.name][torch.from_numpy(table.image_of_vehicle)] = reached
    return found
