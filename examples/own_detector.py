"""A detector of one's own: anything that gives one loss per image, small where it finds nothing, can be attacked."""

import sys

import torch
from torchvision.models.detection import ssdlite320_mobilenet_v3_large

import skyproof.api as sp


class MyDetector(sp.TrainableDetector):
    name, size = "ssdlite", "full"

    def __init__(self):
        super().__init__()
        self.network = ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None, num_classes=2)

    def loss(self, images, targets):
        features = list(self.network.backbone(images).values())
        vehicle = self.network.head(features)["cls_logits"].softmax(-1)[..., 1]
        return -torch.log1p(-vehicle.clamp(max=0.999)).mean(1)


run, out = sys.argv[1:3]
world = sp.AttackWorld.open(f"{run}/backgrounds", f"{run}/fleets/attack", sp.SceneSettings(128, vehicles_maximum=1))
texture = sp.UniversalTexture("T-U", generator=torch.Generator().manual_seed(0))
steps = int(sys.argv[3]) if len(sys.argv) > 3 else 200
sp.attack(texture, [MyDetector()], world, sp.AttackSettings(steps=steps), f"{out}/T-U")
