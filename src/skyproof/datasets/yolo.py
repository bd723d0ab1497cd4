"""Labels as YOLO text, the training format of Ultralytics."""

from pathlib import Path

from skyproof.datasets.coco import CATEGORY
from skyproof.datasets.dataset import Dataset

_DATA = f"""\
# One dataset serves both splits; to validate on another, name its images folder.
train: images
val: images
names:
  0: {CATEGORY["name"]}
"""


def write_yolo(folder: Path) -> None:
    """Writes `labels/*.txt` and `data.yaml` beside a dataset's images.

    The format has no ignore regions, so they are left out, as are vehicles out of sight.
    """
    dataset = Dataset.open(folder)
    labels = folder / "labels"
    labels.mkdir()
    for name, (width, height), boxes in zip(
        dataset.ids, dataset.sizes_px, dataset.boxes, strict=True
    ):
        lines = []
        for left, top, right, bottom in boxes.tolist():
            if right > left and bottom > top:
                centre = ((left + right) / 2 / width, (top + bottom) / 2 / height)
                parts = (*centre, (right - left) / width, (bottom - top) / height)
                lines.append("0 " + " ".join(f"{part:.7f}" for part in parts) + "\n")
        (labels / f"{name}.txt").write_text("".join(lines), encoding="utf-8")
    (folder / "data.yaml").write_text(_DATA, encoding="utf-8")
