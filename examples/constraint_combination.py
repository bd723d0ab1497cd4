"""A texture of 15 cm blocks in five colours of the ground, on painted parts only, against two detectors of a run."""

import sys

import torch

import skyproof.api as sp

run, out = sys.argv[1:3]
world = sp.AttackWorld.open(f"{run}/backgrounds", f"{run}/fleets/attack", sp.SceneSettings(128, vehicles_maximum=1))
detectors = [sp.load_detector(f"{run}/detectors/{name}")[0] for name in ("retinanet", "faster_rcnn")]
draws = torch.Generator().manual_seed(0)
palette = sp.fit_palette(world.backgrounds.sample_pixels("attack", 1000, generator=draws), seed=0)
camouflage = sp.make_camouflage(sp.read_recipe("T-PixFcMa"), sp.Materials(palette=palette), generator=draws)
steps = int(sys.argv[3]) if len(sys.argv) > 3 else 200
sp.attack(camouflage, detectors, world, sp.AttackSettings(steps=steps), f"{out}/T-PixFcMa")
print(sp.practicality_account(camouflage, world.fleet.batch(world.fleet.ids))["texture"])
