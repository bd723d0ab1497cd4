"""A few rendered images, with and without a camouflage, and the detector that sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import skyproof as sp
from skyproof.detectors.loaded import load_detector
from skyproof.maite import CamouflageAugmentation, DetectorModel
from skyproof.render.dataset import render_dataset
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from tests.rendered_world import make_world


@dataclass(frozen=True)
class Folders:
    """What `skyproof` writes: the folders that MAITE's components open."""

    ground: Path
    fleet: Path
    camouflage: Path
    original: Path
    camouflaged: Path

    def augmentation(self) -> CamouflageAugmentation:
        """The camouflage on the original images."""
        return CamouflageAugmentation(self.camouflage, self.original, self.ground, self.fleet)


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Six scenes, one of them without a vehicle; a white texture covers the vehicles."""
    folder = tmp_path_factory.mktemp("maite")
    world = make_world(folder)
    generator = torch.Generator().manual_seed(0)
    fleet = sample_fleet(FleetSettings(6), generator=generator)
    fleet.save(folder / "fleet")
    settings = SceneSettings(size_px=160, vehicles_minimum=2, vehicles_maximum=4)
    scenes = sample_scenes(settings, world.ground, "test", fleet.sizes_m, 6, generator=generator)
    camouflage = sp.make_camouflage("R-U", generator=generator)
    sp.save_camouflage(folder / "R-U-0", camouflage)
    renderer = sp.TorchRenderer(world.ground)
    render_dataset(folder / "original", scenes, fleet, renderer)
    render_dataset(folder / "camouflaged", scenes, fleet, renderer, camouflage=camouflage)
    return Folders(
        folder / "ground",
        folder / "fleet",
        folder / "R-U-0",
        folder / "original",
        folder / "camouflaged",
    )


@pytest.fixture(scope="session")
def model() -> DetectorModel:
    """The RetinaNet that comes with skyproof."""
    return DetectorModel(load_detector("retinanet"))
