"""Imports, validates and attacks a checkpoint file of torchvision.

A short training makes the file.
"""

from pathlib import Path

import torch
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_fpn

import skyproof as sp
from skyproof.detectors.import_checkpoint import Checkpoint

data, steps = sp.Dataset.open("runs/images/train"), 200
side = data.image(0).shape[-1]  # torchvision would enlarge the images to 800 px
model = fasterrcnn_mobilenet_v3_large_fpn(
    weights=None, weights_backbone=None, num_classes=2, min_size=side
)
optimiser = torch.optim.SGD(model.parameters(), lr=0.005, momentum=0.9)
for step in range(steps):
    boxes = data.boxes[step % len(data)]
    target = {"boxes": boxes, "labels": torch.ones(len(boxes), dtype=torch.long)}
    optimiser.zero_grad()
    sum(model([data.image(step % len(data)) / 255], [target]).values()).backward()
    optimiser.step()
Path("runs/mine").mkdir(parents=True, exist_ok=True)
torch.save({"model": model.state_dict()}, "runs/mine/vehicles.pth")

checkpoint = Checkpoint(
    Path("runs/mine/vehicles.pth"), "torchvision", ["1"], "fasterrcnn_mobilenet_v3_large_fpn"
)
validation = sp.Dataset.open("runs/images/validation")
print(sp.import_detector(checkpoint, validation, "runs/mine/vehicles").validation)
detector = sp.load_detector("runs/mine/vehicles")
world = sp.World.open("runs/demo/backgrounds", "runs/demo/fleets/attack", size_px=128)
texture = sp.make_camouflage("T-U", generator=torch.Generator().manual_seed(0))
sp.attack(texture, [detector], world, sp.AttackSettings(steps=400), "runs/mine/T-U-on-vehicles")
