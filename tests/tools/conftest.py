"""The tools are scripts beside each other, found as they are when one of them is run."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import RemovedVehicle
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import FleetSettings, sample_fleet

sys.path.append(str(Path(__file__).parents[2] / "tools"))

# Coarser than imagery that the tool is made for, so that the tests are quick.
GSD_M = 0.25
SIZE = 200
SIDE = 32  # of a window with its room
CENTRES_PX = (28.0, 76.0, 124.0, 172.0)
RED = (255, 0, 0)


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """Labelled photographs, the same cleared, and two sets of renders of other seeds on that.

    In the photographs vehicles are red rectangles, 12 m from each other.
    """
    folder = tmp_path_factory.mktemp("world")
    draws = np.random.default_rng(0)
    (folder / "tiles" / "test").mkdir(parents=True)
    (folder / "cleared" / "test").mkdir(parents=True)
    tiles = []
    with CocoWriter(folder / "tiles" / "test", gsd_m=GSD_M) as writer:
        for number in range(6):
            coarse = torch.from_numpy(draws.uniform(90, 150, (1, 3, 40, 40)))
            ground = torch.nn.functional.interpolate(coarse, size=(SIZE, SIZE), mode="bilinear")
            ground = (ground[0] + torch.from_numpy(draws.normal(0, 4, (3, SIZE, SIZE)))).byte()
            photograph = Image.fromarray(ground.permute(1, 2, 0).numpy())
            removed, labels = [], []
            for x, y in [(x, y) for x in CENTRES_PX for y in CENTRES_PX]:
                heading = float(draws.uniform(0, math.pi))
                forward = np.array([math.cos(heading), -math.sin(heading)]) * 2.2 / GSD_M
                aside = np.array([math.sin(heading), math.cos(heading)]) * 0.9 / GSD_M
                signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
                corners = [(x, y) + a * forward + b * aside for a, b in signs]
                ImageDraw.Draw(photograph).polygon([tuple(c) for c in corners], fill=RED)
                removed.append(RemovedVehicle(x, y, heading, "picture", 4.4, 1.8))
                box = (*np.min(corners, 0).tolist(), *np.max(corners, 0).tolist())
                labels.append(Annotation(box, (x, y)))
            file = f"test/images/t{number}.png"
            tile = BackgroundTile(f"t{number}", file, "test", SIZE, SIZE, f"t{number}.png")
            writer.add(torch.from_numpy(np.array(photograph)).permute(2, 0, 1), tile.id, labels)
            (folder / "cleared" / "test" / "images").mkdir(exist_ok=True)
            save_tile(folder / "cleared", tile, ground)
            tiles.append(replace(tile, removed=tuple(removed)))
    write_index(folder / "tiles", GSD_M, [replace(tile, removed=()) for tile in tiles])
    write_index(folder / "cleared", GSD_M, tiles)
    cleared = BackgroundSet.open(folder / "cleared")
    fleet = sample_fleet(FleetSettings(8), generator=torch.Generator().manual_seed(0))
    settings = SceneSettings(size_px=SIZE, vehicles_maximum=16, vehicles_minimum=16,
                             tilt_maximum_rad=0.0, places="removed")  # fmt: skip
    for seed, name in enumerate(("first", "second")):
        generator = torch.Generator().manual_seed(seed)
        scenes = sample_scenes(
            settings, cleared, "test", fleet.sizes_m, 8, generator=generator, prefix=name
        )
        renderer = TorchRenderer(cleared, RenderSettings(supersampling=2))
        render_dataset(folder / name, scenes, fleet, renderer)
        # Both sides draw from one fleet, so no vehicle tells; each counts as one of its own.
        path = folder / name / "annotations.json"
        document = json.loads(path.read_text())
        for row in document["annotations"]:
            row["vehicle"] = f"{name}-{row['id']}"
        path.write_text(json.dumps(document))
    return folder
