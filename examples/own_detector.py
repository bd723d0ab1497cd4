"""Attacks a detector of your own.

It needs one loss per image, small if it finds nothing.
"""

import torch
from torchvision.models.detection import ssdlite320_mobilenet_v3_large

import skyproof as sp


class MyDetector(sp.TrainableDetector):
    def __init__(self):
        super().__init__()
        self.name, self.network = (
            "mine",
            ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None),
        )

    def loss(self, images, targets):
        scores = self.network.head(list(self.network.backbone(images).values()))[
            "cls_logits"
        ].softmax(-1)
        return scores[..., 3].mean(1)  # class 3 of COCO is "car"


world = sp.World.open("runs/demo/backgrounds", "runs/demo/fleets/attack", size_px=128)
texture = sp.make_camouflage("T-U", generator=torch.Generator().manual_seed(0))
sp.attack(texture, [MyDetector()], world, sp.AttackSettings(steps=400), "runs/mine/T-U")
