"""Which detectors to test, and small stand-in images: dark ground with bright bars as vehicles."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from skyproof.datasets.dataset import Dataset
from skyproof.detectors.blueprint import Blueprint
from skyproof.detectors.ultralytics_detectors import _quiet_import

NEEDS_YOLO = [
    pytest.mark.yolo,
    pytest.mark.skipif(
        importlib.util.find_spec("ultralytics") is None, reason="ultralytics is not installed"
    ),
]
YOLO = pytest.param("yolov5", marks=NEEDS_YOLO)


def needs_yolo(test: Callable[..., Any]) -> Callable[..., Any]:
    """Marks a test that Ultralytics is needed for.

    It is not imported here, as that would patch other libraries.
    """
    for mark in NEEDS_YOLO:
        test = mark(test)
    return test


NAMES = ["retinanet", "faster_rcnn", YOLO]


def bar_images(count: int, size_px: int = 96, *, seed: int) -> Dataset:
    """Images with 0 to 2 bright bars of 36x15 px, along either axis, on noise."""
    generator = torch.Generator().manual_seed(seed)
    images, boxes = [], []
    for index in range(count):
        image = 0.3 + 0.05 * torch.randn(3, size_px, size_px, generator=generator)
        own = []
        for slot in range(index % 3):
            length, width = (36, 15) if torch.rand(1, generator=generator) < 0.5 else (15, 36)
            left = int(torch.randint(0, size_px - length, (1,), generator=generator))
            top = slot * size_px // 2 + int(
                torch.randint(0, size_px // 2 - width, (1,), generator=generator)
            )
            image[:, top : top + width, left : left + length] = 0.6 + 0.4 * torch.rand(
                3, 1, 1, generator=generator
            )
            own.append([left, top, left + length, top + width])
        images.append((image.clamp(0, 1) * 255).to(torch.uint8))
        boxes.append(torch.tensor(own, dtype=torch.float32).reshape(-1, 4))
    return Dataset.of_images(images, boxes, gsd_m=0.125)


CLASSES = ["0", "1", "2", "3"]
PLAN = Blueprint(
    "torchvision", "fasterrcnn_mobilenet_v3_large_fpn", CLASSES, [2], 1.0, None, "x.pth", "0"
)


def yolo_plan(file: str, vehicle_classes: list[int]) -> Blueprint:
    """A three-class network of one of the YAML files that Ultralytics brings along."""
    with _quiet_import():
        from ultralytics.nn.tasks import yaml_model_load

    architecture = {**yaml_model_load(file), "nc": 3}
    return replace(
        PLAN,
        kind="ultralytics",
        architecture=architecture,
        classes=CLASSES[:3],
        vehicle_classes=vehicle_classes,
    )


def rt_detr_plan(vehicle_classes: list[int]) -> Blueprint:
    """Ultralytics' RT-DETR with thin layers and 30 queries, for images of 96 px."""
    plan: Any = yolo_plan("rtdetr-l.yaml", vehicle_classes)
    plan.architecture["scales"] = {"l": [0.33, 0.125, 1024]}
    for row in plan.architecture["head"]:
        if row[2] == "AIFI":
            row[3] = [64, 4]
    # Classes, channels, queries, points, heads, layers and channels in between.
    plan.architecture["head"][-1][3] = ["nc", 32, 30, 4, 4, 2, 64]
    return replace(plan, side_px=96)
