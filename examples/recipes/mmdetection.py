"""Assesses a detector of MMDetection. For MMRotate turn the boxes upright with its `rbox2hbox`.

Install `mmdet` and `mmcv`. Change the paths, the number of the vehicle class, and TILE: the side of
the images that the detector usually gets, in pixels. Smaller ones are padded to keep their scale.
"""

import torch
from mmdet.apis import inference_detector, init_detector

import skyproof as sp

CONFIG, WEIGHTS, IMAGERY, LABELS, TILE = "cars.py", "cars.pth", "imagery", "vehicles.gpkg", 640
LOW = {"model.test_cfg.score_thr": 0.01}  # two-stage detectors: model.test_cfg.rcnn.score_thr
network = init_detector(CONFIG, WEIGHTS, device="cpu", cfg_options=LOW)


def mmdet(images):
    height, width = images.shape[2:]
    padded = torch.nn.functional.pad(images, [0, max(0, TILE - width), 0, max(0, TILE - height)])
    pictures = (padded * 255).round().byte().flip(1).permute(0, 2, 3, 1).cpu().numpy()  # BGR
    found = [each.pred_instances for each in inference_detector(network, [*pictures])]
    kept = [each[(each.bboxes[:, :2] < torch.tensor([width, height])).all(1)] for each in found]
    return [{"boxes": one.bboxes, "scores": one.scores, "labels": one.labels} for one in kept]


print(sp.assess(mmdet, "runs/mine/mmdet", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
