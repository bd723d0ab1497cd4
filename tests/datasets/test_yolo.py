"""Labels as YOLO text: the same boxes come back, and Ultralytics accepts them."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import Dataset, write_yolo
from skyproof.imagery.frames import read_frames_folder


@pytest.fixture
def dataset(tmp_path):
    """Two images of 120 x 96 px: three vehicles, one out of sight and an ignore region; nothing."""
    folder = tmp_path / "test"
    with CocoWriter(folder, gsd_m=0.125) as writer:
        image = torch.randint(
            256, (3, 96, 120), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
        )
        rows = [
            Annotation((55.25, 20.5, 74.0, 43.0), (64.6, 31.7)),
            Annotation((10.1, 12.3, 30.6, 21.9), (20.0, 17.0)),
            Annotation((0.0, 60.0, 4.0, 70.0), (2.0, 65.0)),
            Annotation((0.0, 0.0, 0.0, 0.0), (-9.0, 17.0), 0.0),
            Annotation((80.0, 50.0, 120.0, 96.0), (100.0, 73.0), ignore=True),
        ]
        writer.add(image, "tile-a", rows)
        writer.add(image.flip(2), "tile-b", [])
    write_yolo(folder)
    return folder


def test_boxes_in_sight_come_back(dataset):
    (dataset / "annotations.json").rename(dataset.parent / "annotations.json")
    after = read_frames_folder(
        dataset, labels=None, gsd_m=0.125, target_gsd_m=0.125, classes=("vehicle",), border_px=0.0
    )
    (dataset.parent / "annotations.json").rename(dataset / "annotations.json")
    before = Dataset.open(dataset)
    assert after.ids == ["tile-a", "tile-b"]
    for index, count in enumerate((3, 0)):
        assert torch.equal(after.image(index), before.image(index))
        expected = before.boxes[index][:count]
        torch.testing.assert_close(after.boxes[index], expected, atol=1e-3, rtol=0)


LOAD = """
import json, sys
from ultralytics.data.dataset import YOLODataset
from ultralytics.data.utils import check_det_dataset
data = check_det_dataset(sys.argv[1], autodownload=False)
loaded = YOLODataset(img_path=data["train"], data=data, task="detect", augment=False, imgsz=128)
rows = {
    row["im_file"].rpartition("/")[2]: [row["shape"], row["bboxes"].tolist()]
    for row in loaded.get_labels()
}
print(json.dumps([data["names"], rows]))
"""


@pytest.mark.yolo
def test_ultralytics_loads_it(dataset, tmp_path):
    if find_spec("ultralytics") is None:
        pytest.skip("ultralytics is not installed")
    # In a process of its own, because Ultralytics changes Pillow for all that follows.
    quiet = {
        "YOLO_OFFLINE": "true",
        "YOLO_CONFIG_DIR": str(tmp_path / "config"),
        "YOLO_VERBOSE": "false",
    }
    call = [sys.executable, "-c", LOAD, str(dataset / "data.yaml")]
    answer = subprocess.run(
        call, env=os.environ | quiet, capture_output=True, text=True, check=True
    )
    names, by_name = json.loads(answer.stdout.splitlines()[-1])
    assert names == {"0": "vehicle"}
    assert by_name["tile-a.png"][0] == [96, 120]
    expected = [
        [(55.25 + 74) / 240, (20.5 + 43) / 192, 18.75 / 120, 22.5 / 96],
        [40.7 / 240, 34.2 / 192, 20.5 / 120, 9.6 / 96],
        [2 / 120, 65 / 96, 4 / 120, 10 / 96],
    ]
    np.testing.assert_allclose(by_name["tile-a.png"][1], expected, atol=1e-6)
    assert by_name["tile-b.png"][1] == []
