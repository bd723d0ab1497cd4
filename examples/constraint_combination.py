"""Optimises blocks of about 15 cm in five colours of the ground, on painted parts only.

The attack runs against the detector of the demo.
"""

from pathlib import Path

import torch

import skyproof as sp
from skyproof.camouflage.palette import ground_palette

world = sp.World.open("runs/demo/backgrounds", "runs/demo/fleets/attack", size_px=128)
detectors = [sp.load_detector(folder) for folder in sorted(Path("runs/demo/detectors").iterdir())]
draws = torch.Generator().manual_seed(0)
palette = ground_palette(world.backgrounds)
camouflage = sp.make_camouflage("T-PixFcMa", palette=palette, generator=draws)
sp.attack(camouflage, detectors, world, sp.AttackSettings(steps=400), "runs/mine/T-PixFcMa")
