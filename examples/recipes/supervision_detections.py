"""Assesses a detector that answers with supervision's `Detections`, here RF-DETR as a black box.

`skyproof assess` takes RF-DETR's checkpoints themselves, and attacks them with gradients. Install
`rfdetr`. Change its size, the paths, the number of the vehicle class, and TILE: the side of the
images that the detector usually gets, in pixels. Smaller ones are padded to keep their scale.
"""

from PIL import Image
from rfdetr import RFDETRMedium

import skyproof as sp

WEIGHTS, IMAGERY, LABELS, TILE = "vehicles.pth", "imagery", "vehicles.gpkg", 640
network = RFDETRMedium(pretrain_weights=WEIGHTS)


def rf_detr(images):
    height, width = images.shape[2:]
    pictures = (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
    area = (0, 0, max(TILE, width), max(TILE, height))
    padded = [Image.fromarray(each).crop(area) for each in pictures]
    found = [network.predict(each, threshold=0.01) for each in padded]
    kept = [each[(each.xyxy[:, :2] < (width, height)).all(1)] for each in found]
    return [{"boxes": one.xyxy, "scores": one.confidence, "labels": one.class_id} for one in kept]


print(sp.assess(rf_detr, "runs/mine/rf", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
