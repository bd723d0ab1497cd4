"""The dataset on disk: run lengths, boxes, round trip, and the reference reader."""

import json

import pytest
import torch

from skyproof.datasets.coco import (
    Annotation,
    CocoWriter,
    encode_rle,
)
from skyproof.datasets.dataset import Dataset
from skyproof.errors import StoredFileError


def _image(seed, height=20, width=30):
    return torch.randint(
        256, (3, height, width), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed)
    )


def _mask():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[4:9, 10:17] = True
    mask[6, 17] = True
    return mask


def _write(folder):
    with CocoWriter(folder, gsd_m=0.125) as writer:
        first = Annotation((10.0, 4.0, 18.0, 9.0), (13.5, 6.5), 0.75, _mask(), "van-3", 0)
        writer.add(
            _image(0),
            "scene-a",
            [first, Annotation((0.5, 1.5, 4.0, 6.25), (2.0, 4.0), ignore=True)],
        )
        writer.add(_image(1, 24, 16), "scene-b", [])


def test_run_lengths_by_hand():
    # Columns are (0, 1, 1) and (1, 0, 0): one zero, three ones, two zeros.
    assert encode_rle(torch.tensor([[0, 1], [1, 0], [1, 0]]).bool()) == {
        "size": [3, 2],
        "counts": [1, 3, 2],
    }
    assert encode_rle(torch.tensor([[1, 0]]).bool()) == {"size": [1, 2], "counts": [0, 1, 1]}
    assert encode_rle(torch.zeros(2, 2).bool())["counts"] == [4]
    assert encode_rle(torch.ones(2, 2).bool())["counts"] == [0, 4]


def test_run_lengths_decode_in_the_reference():
    reference = pytest.importorskip("faster_coco_eval.core.mask")
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        mask = torch.rand(13, 17, generator=generator) < 0.4
        compressed = reference.frPyObjects(encode_rle(mask), 13, 17)
        assert torch.equal(torch.from_numpy(reference.decode(compressed)).bool(), mask)


def test_annotation_fields(tmp_path):
    _write(tmp_path)
    row = json.loads((tmp_path / "annotations.json").read_text())["annotations"][0]
    assert row["bbox"] == [10, 4, 8, 5]
    assert row["area"] == 36
    assert row["iscrowd"] == 0
    assert row["centre_px"] == [13.5, 6.5]
    assert (row["visible_fraction"], row["vehicle"], row["placement_index"]) == (0.75, "van-3", 0)


def test_opens_in_the_reference(tmp_path):
    coco = pytest.importorskip("faster_coco_eval").COCO
    _write(tmp_path)
    dataset = coco(str(tmp_path / "annotations.json"))
    assert sorted(dataset.getImgIds()) == [1, 2]
    assert dataset.loadCats(1)[0]["name"] == "vehicle"
    annotation = dataset.loadAnns(dataset.getAnnIds(imgIds=[1], iscrowd=False))[0]
    assert torch.equal(torch.from_numpy(dataset.annToMask(annotation)).bool(), _mask())


def _fail_midway(folder):
    with CocoWriter(folder, gsd_m=0.125) as writer:
        writer.add(_image(0), "scene-a", [])
        raise RuntimeError("stop")


def test_failed_block_leaves_no_annotations(tmp_path):
    with pytest.raises(RuntimeError, match="stop"):
        _fail_midway(tmp_path)
    assert not (tmp_path / "annotations.json").exists()
    with pytest.raises(StoredFileError, match=r"annotations\.json is missing"):
        Dataset.open(tmp_path)
