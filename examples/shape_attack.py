"""Attacks one detector with a body that may grow by up to a fifth of its width."""

import torch

import skyproof as sp

world = sp.World.open("runs/demo/backgrounds", "runs/demo/fleets/attack", size_px=128)
detector = sp.load_detector("runs/demo/detectors/retinanet")
camouflage = sp.make_camouflage("S-O@0.2", generator=torch.Generator().manual_seed(0))
sp.attack(camouflage, [detector], world, sp.AttackSettings(steps=200), "runs/mine/S-O@0.2")
