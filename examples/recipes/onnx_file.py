"""Assesses an ONNX file of Ultralytics with the output `[1, 4 + classes, boxes]`, the default.

Install `onnxruntime`. Change the paths, the number of the vehicle class, and SIDE: the side of the
network's input, in pixels. Smaller images are padded to keep their scale.
"""

import numpy as np
import onnxruntime

import skyproof as sp

WEIGHTS, IMAGERY, LABELS, SIDE = "vehicles.onnx", "imagery", "vehicles.gpkg", 640
session = onnxruntime.InferenceSession(WEIGHTS, providers=["CPUExecutionProvider"])


def ask(image):
    padded = np.pad(image, [(0, 0), (0, SIDE - image.shape[1]), (0, SIDE - image.shape[2])])
    rows = session.run(None, {"images": padded[None]})[0][0]
    inside = (rows[:4] > 0).all(0) & (rows[0] < image.shape[2]) & (rows[1] < image.shape[1])
    x, y, width, height, *scores = rows[:, inside]
    boxes = np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=1)
    return {"boxes": boxes, "scores": np.max(scores, 0), "labels": np.argmax(scores, 0)}


def onnx(images):
    return [ask(each) for each in images.cpu().numpy()]


print(sp.assess(onnx, "runs/mine/onnx", imagery=IMAGERY, labels=LABELS, vehicle_classes=["0"]))
