"""Evaluates a black-box detector, from any library or over HTTP.

Freezes its threshold, measures its success rates and writes a report.
"""

import torch

import skyproof as sp

network = sp.load_detector("runs/demo/detectors/retinanet").detector


def ask(picture):  # [H, W, 3] bytes, replace by a call of your library or server
    found = network.detect(torch.from_numpy(picture).permute(2, 0, 1)[None] / 255)[0]
    return torch.cat([found.boxes, found.scores[:, None]], dim=1).tolist()


class BlackBox:
    name = "black_box"

    def detect(self, images):
        pictures = (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        rows = [torch.tensor(ask(picture)).reshape(-1, 5) for picture in pictures]
        rows = [row[row[:, 4].argsort(descending=True)] for row in rows]
        return [sp.Detections(boxes=row[:, :4], scores=row[:, 4]) for row in rows]


demo = "runs/demo"
validation = sp.Dataset.open("runs/images/validation")  # any folder with annotations.json
threshold = sp.validate(BlackBox(), validation)["threshold"]
card = sp.DetectorCard("black_box", threshold=threshold, gsd_m=validation.gsd_m)
camouflages = {
    name: sp.load_camouflage(f"{demo}/camouflages/{name}") for name in ("T-U", "R-U-0", "R-U-1")
}
sp.measure(
    [sp.LoadedDetector(BlackBox(), card)],
    sp.Dataset.open(f"{demo}/datasets/test").scenes,
    camouflages,
    fleet=sp.Fleet.load(f"{demo}/fleets/test"),
    renderer=sp.TorchRenderer(sp.BackgroundSet.open(f"{demo}/backgrounds")),
    folder="runs/mine/black_box/scores/first",
)
print(sp.write_report("runs/mine/black_box"))
