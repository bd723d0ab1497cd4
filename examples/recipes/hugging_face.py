"""Assesses a detector of Hugging Face's transformers that skyproof cannot import, such as YOLOS.

Folders of DETR and its relatives are assessed with gradients, and need no such program. Install
`transformers`. Change the paths, the number of the vehicle class, and TILE: the side of the images
that the detector usually gets, in pixels. Smaller ones are padded to keep their scale.
"""

import torch
from transformers import AutoImageProcessor, AutoModelForObjectDetection

import skyproof as sp

FOLDER, IMAGERY, LABELS, TILE = "vehicles", "imagery", "vehicles.gpkg", 640
processor = AutoImageProcessor.from_pretrained(FOLDER)
network = AutoModelForObjectDetection.from_pretrained(FOLDER)


def detr(images):
    height, width = images.shape[2:]
    side = max(TILE, height, width)
    padded = torch.nn.functional.pad(images.cpu(), [0, side - width, 0, side - height])
    outputs = network(**processor([*(padded * 255).round().byte()], return_tensors="pt"))
    found = processor.post_process_object_detection(outputs, 0.01, [(side, side)] * len(images))
    kept = [(each["boxes"][:, :2] < torch.tensor([width, height])).all(1) for each in found]
    return [{key: each[key][one] for key in each} for each, one in zip(found, kept, strict=True)]


print(sp.assess(detr, "runs/mine/detr", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
