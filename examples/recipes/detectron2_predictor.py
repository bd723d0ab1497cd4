"""Assesses a detector of Detectron2. Its network sees the images at their 12.5 cm per pixel.

Install `detectron2`. Change the paths and the number of the vehicle class.
"""

from detectron2.config import get_cfg
from detectron2.engine import DefaultPredictor

import skyproof as sp

CONFIG, WEIGHTS, IMAGERY, LABELS = "vehicles.yaml", "vehicles.pth", "imagery", "vehicles.gpkg"
settings = get_cfg()
settings.merge_from_file(CONFIG)
settings.MODEL.WEIGHTS, settings.MODEL.DEVICE, settings.INPUT.MIN_SIZE_TEST = WEIGHTS, "cpu", 0
settings.MODEL.ROI_HEADS.SCORE_THRESH_TEST = settings.MODEL.RETINANET.SCORE_THRESH_TEST = 0.01
predictor = DefaultPredictor(settings)


def ask(picture):
    found = predictor(picture[:, :, ::-1])["instances"]  # BGR
    return {"boxes": found.pred_boxes.tensor, "scores": found.scores, "labels": found.pred_classes}


def detectron2(images):
    return [ask(each) for each in (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()]


print(sp.assess(detectron2, "runs/mine/d2", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
