"""A detector that only answers, through any library or over HTTP, is judged like any other.

Its threshold is frozen, its success rates are measured, and a report is written.
"""

import torch

import skyproof as sp

network = sp.load_detector("runs/demo/detectors/retinanet").detector


# In place of this ask your library, or a server: requests.post(URL, picture.tobytes()).json().
def ask(picture):  # [H, W, 3] bytes
    found = network.detect(torch.from_numpy(picture).permute(2, 0, 1)[None] / 255)[0]
    return [
        [*box, score]
        for box, score in zip(found.boxes.tolist(), found.scores.tolist(), strict=True)
    ]


class BlackBox:
    name = "black_box"

    def detect(self, images):
        pictures = (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        rows = [torch.tensor(ask(picture)).reshape(-1, 5) for picture in pictures]
        rows = [row[row[:, 4].argsort(descending=True)] for row in rows]
        return [sp.Detections(boxes=row[:, :4], scores=row[:, 4]) for row in rows]


data = "runs/demo/datasets"
validation = sp.Dataset.open(
    f"{data}/validation"
)  # any folder with annotations.json, real tiles too
threshold = sp.validate(BlackBox(), validation)["threshold"]
judge = sp.LoadedDetector(
    BlackBox(), sp.DetectorCard("black_box", threshold=threshold, gsd_m=validation.gsd_m)
)
note = "the images that froze the threshold"
clean = [sp.CleanSet("validation", validation, real=False, note=note)]  # they are rendered
original = sp.Dataset.open(f"{data}/test")
renderer = sp.TorchRenderer(sp.BackgroundSet.open("runs/demo/backgrounds"))
fleet = sp.Fleet.load("runs/demo/fleets/test")
worn = {name: f"runs/mine/black_box/images/{name}" for name in ("T-U", "R-U-0", "R-U-1")}
for name, place in worn.items():
    camouflage = sp.load_camouflage(f"runs/demo/camouflages/{name}")
    sp.render_dataset(place, original.scenes, fleet, renderer, camouflage=camouflage)
sp.score_detectors(
    [judge],
    "runs/mine/black_box/scores/first",
    original=f"{data}/test",
    camouflaged=worn,
    clean=clean,
)
print(sp.write_report("runs/mine/black_box"))
