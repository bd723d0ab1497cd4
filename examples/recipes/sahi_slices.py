"""Assesses a detector that searches images slice by slice with SAHI.

Install `sahi` and the detector's library. Change its kind, the paths, the vehicle classes, SLICE
(pixels of a slice's side) and SIDE (pixels to which the network enlarges it).
"""

from sahi import AutoDetectionModel
from sahi.predict import get_sliced_prediction

import skyproof as sp

WEIGHTS, IMAGERY, LABELS, SLICE, SIDE = "vehicles.pt", "imagery", "vehicles.gpkg", 256, 640
model = AutoDetectionModel.from_pretrained("ultralytics", WEIGHTS, confidence_threshold=0.01)


def ask(picture):
    model.image_size = SIDE * min(SLICE, max(picture.shape)) // SLICE
    found = get_sliced_prediction(picture, model, SLICE, SLICE, postprocess_type="NMS", verbose=0)
    boxes = [each.bbox.to_xyxy() for each in found.object_prediction_list]
    scores = [each.score.value for each in found.object_prediction_list]
    labels = [each.category.name for each in found.object_prediction_list]
    return {"boxes": boxes, "scores": scores, "labels": labels}


def sahi(images):
    return [ask(each) for each in (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()]


print(sp.assess(sahi, "runs/mine/sahi", imagery=IMAGERY, labels=LABELS, vehicle_classes=["car"]))
