"""Measures a detector from any library or service, and writes a report.

Labelled images freeze its threshold.
"""

import skyproof as sp

demo = "runs/demo"
network: sp.Detector = sp.load_detector(f"{demo}/detectors/retinanet")


def black_box(images):  # [B, 3, H, W] in [0, 1]; replace by a call of your library or service
    return [(found.boxes, found.scores) for found in network.detect(images)]


detector = sp.load_detector(black_box, sp.Dataset.open("runs/images/validation"))
camouflages = {
    name: sp.load_camouflage(f"{demo}/camouflages/{name}") for name in ("T-U", "R-U-0", "R-U-1")
}
sp.measure(
    [detector],
    sp.Dataset.open(f"{demo}/datasets/test").scenes,
    camouflages,
    fleet=sp.Fleet.load(f"{demo}/fleets/test"),
    renderer=sp.TorchRenderer(sp.BackgroundSet.open(f"{demo}/backgrounds")),
    folder="runs/mine/black_box/scores/first",
)
print(sp.write_report("runs/mine/black_box"))
