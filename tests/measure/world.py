"""A small world to check detectors in: noisy ground, two vehicles, three scenes, toy detectors."""

from dataclasses import replace

import torch

from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.sensor import Sensor
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from tests.render.bodies import PlainGround

GSD_M = 0.125
SIZE_PX = 96
SPLITS = ("test", "test", "test", "attack", "validation")


class Toy:
    """Finds the vehicles of three scenes, shown again and again, unless it `misses` their colour.

    It knows where they are, so that it answers at once; and it looks at nothing but their middles.
    """

    def __init__(self, name, scenes, fleet, misses=lambda red, green, blue: False):
        renderer = TorchRenderer(PlainGround(0.5))
        frames = renderer(scenes, placed_vehicles(fleet, scenes))
        self.name = name
        self.places = [
            frames.boxes[frames.scene_index == index].round() for index in range(len(scenes))
        ]
        self.misses = misses
        self.images = 0
        self.contrasts = []

    def detect(self, images):
        self.contrasts.append((images - images.mean()).abs().mean().item())
        found = []
        for image in images:
            boxes = self.places[self.images % len(self.places)]
            self.images += 1
            seen = [box for box in boxes if not self.misses(*_middle(image, box))]
            kept = torch.stack(seen) if seen else torch.zeros(0, 4)
            found.append(Detections(kept, torch.linspace(0.9, 0.8, len(kept))))
        return found


def _middle(image, box):
    x, y = ((box[:2] + box[2:]) / 2).int().tolist()
    return image[:, y - 3 : y + 4, x - 3 : x + 4].mean((1, 2)).tolist()


def make_backgrounds(folder, size_px=SIZE_PX):
    generator = torch.Generator().manual_seed(0)
    tiles = []
    for number, split in enumerate(SPLITS):
        name = f"tile-{number}"
        tile = BackgroundTile(name, f"tiles/{name}.png", split, size_px, size_px, "procedural")
        pixels = torch.randint(90, 160, (3, size_px, size_px), generator=generator)
        save_tile(folder, tile, pixels.byte())
        tiles.append(tile)
    write_index(folder, GSD_M, tiles, Sensor(blur_sigma_px=2.0, noise=0.01))
    return BackgroundSet.open(folder)


def make_fleet():
    return sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))


def make_scenes(backgrounds, fleet):
    """One scene with two vehicles on each of the three test tiles."""
    drawn = sample_scenes(
        SceneSettings(size_px=SIZE_PX, vehicles_minimum=2, vehicles_maximum=2),
        backgrounds,
        "test",
        fleet.sizes_m,
        3,
        generator=torch.Generator().manual_seed(3),
    )
    return [
        replace(scene, background=replace(scene.background, tile=f"tile-{number}"))
        for number, scene in enumerate(drawn)
    ]


def judging(detector, threshold=0.5):
    return BlackBoxDetector(
        detector, card=DetectorCard(detector.name, threshold=threshold, gsd_m=GSD_M)
    )
