"""MAITE's own `evaluate` measures how many vehicles a texture hides from a detector."""

import json
from pathlib import Path

from maite.tasks import evaluate

from skyproof.maite import CamouflageAugmentation, DetectorModel, HiddenVehicles, VehicleDataset

demo = Path("runs/demo")
model = DetectorModel(demo / "detectors/retinanet")
dataset = VehicleDataset(demo / "datasets/test")
camouflage = CamouflageAugmentation(
    demo / "camouflages/T-U", demo / "datasets/test", demo / "backgrounds", demo / "fleets/test"
)
hidden, _, _ = evaluate(
    model=model,
    dataset=dataset,
    augmentation=camouflage,
    metric=HiddenVehicles(model, dataset),
    batch_size=8,
)
Path("runs/mine").mkdir(parents=True, exist_ok=True)
Path("runs/mine/hidden.json").write_text(json.dumps(hidden))
