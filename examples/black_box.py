"""A detector that only answers, through any library or over HTTP: threshold frozen, success rates, report."""

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
clean = [sp.CleanSet("validation", validation, "the images that froze the threshold")]
worn = {name: f"{data}/test-{name}" for name in ("T-U", "R-U-0", "R-U-1")}
sp.evaluate_pairs([judge], f"{data}/test", worn, "runs/mine/black_box/evaluation", clean=clean)
print(sp.write_report("runs/mine/black_box"))
