"""The detectors that come with skyproof in a small world, and what attacks on them reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from skyproof.attacks.attack import attack
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.world import World
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import REFERENCE_DETECTORS
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import match_images
from skyproof.scenes.scene import Scene
from skyproof.scenes.settings import SceneSettings
from tests.rendered_world import SIDE_PX, RenderedWorld, make_world

TEST_SCENES = 80
ATTACK = AttackSettings(
    steps=25, batch_size=8, balance_batches=2, preview_every=1000, checkpoint_every=1000
)
SHAPE_STEPS = 40

Found = dict[str, Tensor]
"""Per detector whether it finds the vehicle of each test scene, `[TEST_SCENES]` bool."""


@dataclass(frozen=True)
class Attacked:
    """Detectors in a world that they never saw.

    Attributes:
        world: ground and vehicles.
        detectors: RetinaNet and Faster R-CNN, slim, as they come with skyproof.
        thresholds: frozen, by name.
        test: scenes with one vehicle each, on ground and of vehicles that nothing was learnt on.
        clean: which of them are found without camouflage.
    """

    world: RenderedWorld
    detectors: list[TrainableDetector]
    thresholds: dict[str, float]
    test: list[Scene]
    clean: Found

    def learn(
        self, name: str, folder: Path, against: list[TrainableDetector] | None = None
    ) -> Camouflage:
        """Learns a camouflage, against both detectors where none is named."""
        scenes = SceneSettings(size_px=SIDE_PX, vehicles_maximum=1)
        fleet = self.world.fleets["attack"]
        world = World(self.world.renderer(), self.world.ground, fleet, scenes)
        camouflage = drawn(name)
        settings = ATTACK
        if camouflage.name.kind == "shape":
            settings = replace(ATTACK, steps=SHAPE_STEPS)
        return attack(camouflage, against or self.detectors, world, settings, folder)

    def success(self, camouflage: Camouflage) -> dict[str, float]:
        """The share of the vehicles found before that each detector loses."""
        images = self.world.images("test", self.test, camouflage)
        after = found_by(self.detectors, self.thresholds, images)
        return {
            name: float((before & ~after[name]).sum() / before.sum())
            for name, before in self.clean.items()
        }


def drawn(name: str, seed: int = 0) -> Camouflage:
    """A camouflage as it starts; of a random one, as it is."""
    return make_camouflage(name, generator=torch.Generator().manual_seed(seed))


def make_attacked(folder: Path) -> Attacked:
    """Draws ground and vehicles, and shows them to the detectors."""
    world = make_world(folder)
    loaded = [load_detector(name) for name in REFERENCE_DETECTORS]
    detectors = [each.requires_grad_(False) for each in loaded]
    thresholds = {each.name: each.threshold for each in loaded}
    test = world.scenes("test", TEST_SCENES, 1, 1)
    clean = found_by(detectors, thresholds, world.images("test", test))
    return Attacked(world, detectors, thresholds, test, clean)


def found_by(
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
