"""Assesses a detector of LibreYOLO.

Install `libreyolo`. Change the paths, the number of the vehicle class, and TILE: the side of the
images that the detector usually gets, in pixels. Smaller ones are padded to keep their scale.
"""

import torch
from libreyolo import LibreYOLO
from PIL import Image

import skyproof as sp

WEIGHTS, IMAGERY, LABELS, TILE = "vehicles.pt", "imagery", "vehicles.gpkg", 640
network = LibreYOLO(WEIGHTS, device="cpu")


def yolo(images):
    height, width = images.shape[2:]
    pictures = (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
    area = (0, 0, max(TILE, width), max(TILE, height))
    padded = [Image.fromarray(each).crop(area) for each in pictures]
    found = [each.boxes for each in network(padded, conf=0.01)]
    kept = [each[(each.xyxy[:, :2] < torch.tensor([width, height])).all(1)] for each in found]
    return [{"boxes": one.xyxy, "scores": one.conf, "labels": one.cls} for one in kept]


print(sp.assess(yolo, "runs/mine/yolo", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
