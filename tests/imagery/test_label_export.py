"""Labels out and in again: the same boxes in every form, which other readers accept."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from rasterio.warp import transform

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ImageryError, RunFolderError, StoredFileError
from skyproof.files import write_json
from skyproof.imagery.frames import read_frames_folder
from skyproof.imagery.labels.export import Exported, export_labels
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import GroundLabels, bounds
from skyproof.main import run

CORNERS = ((70.0, 20.0), (74.0, 23.0), (59.0, 43.0), (55.0, 40.0))
BEYOND = ((-30.0, 60.0), (-30.0, 70.0), (4.0, 70.0), (4.0, 60.0))


@pytest.fixture
def dataset(tmp_path):
    """Two images of 120 x 96 px: three vehicles and an ignore region; nothing."""
    folder = tmp_path / "set" / "test"
    mask = torch.zeros(96, 120, dtype=torch.bool)
    mask[22:40, 57:72] = True
    with CocoWriter(folder, gsd_m=0.125) as writer:
        image = torch.randint(
            256, (3, 96, 120), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
        )
        rows = [
            Annotation((55.25, 20.5, 74.0, 43.0), (64.6, 31.7), mask=mask, corners_px=CORNERS),
            Annotation((10.1, 12.3, 30.6, 21.9), (20.0, 17.0)),
            Annotation((0.0, 60.0, 4.0, 70.0), (2.0, 65.0), corners_px=BEYOND),
            Annotation((80.0, 50.0, 120.0, 96.0), (100.0, 73.0), ignore=True),
        ]
        writer.add(image, "tile-a", rows)
        writer.add(image.flip(2), "tile-b", [])
    return folder


def frames(folder, labels=None, classes=("vehicle",)):
    return read_frames_folder(
        folder, labels=labels, gsd_m=0.125, target_gsd_m=0.125, classes=classes, border_px=0.0
    )


@pytest.mark.parametrize("form", ["coco", "yolo"])
def test_upright_boxes_come_back(dataset, tmp_path, form):
    out = tmp_path / ("labels.json" if form == "coco" else "yolo")
    done = export_labels(dataset, form, out)
    assert done == (Exported(2, 3, 1) if form == "coco" else Exported(2, 3, 0, left_out=1))
    before = Dataset.open(dataset)
    after = frames(dataset, out) if form == "coco" else frames(out)
    assert after.ids == ["tile-a", "tile-b"]
    for index in range(2):
        assert torch.equal(after.image(index), before.image(index))
        torch.testing.assert_close(after.boxes[index], before.boxes[index], atol=1e-3, rtol=0)
    assert after.ignore[0].tolist() == (before.ignore[0].tolist() if form == "coco" else [])


def test_oriented_boxes_come_back(dataset, tmp_path):
    assert export_labels(dataset, "dota", tmp_path / "dota") == Exported(2, 3, 1, upright=2)
    labels = read_labels(tmp_path / "dota")
    assert labels.images["tile-b"] == ()
    assert labels.sizes_px["tile-a"] == (120, 96)
    oriented, upright, cut, ignored = labels.images["tile-a"]
    assert oriented.corners == CORNERS
    assert bounds(upright) == pytest.approx((10.1, 12.3, 30.6, 21.9))
    # Its corners' middle is outside of the image: no reader would take it.
    assert bounds(cut) == (0, 60, 4, 70)
    assert bounds(ignored) == (80, 50, 120, 96)
    assert [label.ignore for label in labels.images["tile-a"]] == [False, False, False, True]
    after, before = frames(tmp_path / "dota"), Dataset.open(dataset)
    torch.testing.assert_close(after.boxes[0][1:], before.boxes[0][1:], atol=6e-3, rtol=0)
    torch.testing.assert_close(after.ignore[0], before.ignore[0], atol=6e-3, rtol=0)


def test_coco_opens_in_the_reference_and_scores_itself_perfect(dataset, tmp_path):
    reference = pytest.importorskip("faster_coco_eval")
    export_labels(dataset, "coco", tmp_path / "labels.json")
    document = json.loads((tmp_path / "labels.json").read_text())
    assert {key for row in document["annotations"] for key in row} == {
        *("id", "image_id", "category_id", "bbox", "iscrowd", "area", "segmentation")
    }
    assert [row["file_name"] for row in document["images"]] == [
        "images/tile-a.png",
        "images/tile-b.png",
    ]
    truth = reference.COCO(str(tmp_path / "labels.json"))
    own = truth.loadAnns(truth.getAnnIds(iscrowd=False))
    assert int(truth.annToMask(own[0]).sum()) == 18 * 15
    found = [
        {key: row[key] for key in ("image_id", "category_id", "bbox")} | {"score": 0.9}
        for row in own
    ]
    # Half the crowd region is found as well: neither right nor wrong.
    found.append({"image_id": 1, "category_id": 1, "bbox": [80, 50, 30, 30], "score": 0.95})
    judge = reference.COCOeval_faster(truth, truth.loadRes(found), "bbox")
    judge.evaluate()
    judge.accumulate()
    judge.summarize()
    assert judge.stats[0] == pytest.approx(1.0)


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
def test_ultralytics_loads_the_yolo_form(dataset, tmp_path):
    if find_spec("ultralytics") is None:
        pytest.skip("ultralytics is not installed")
    export_labels(dataset, "yolo", tmp_path / "yolo")
    # In a process of its own, because Ultralytics changes Pillow for all that follows.
    quiet = {
        "YOLO_OFFLINE": "true",
        "YOLO_CONFIG_DIR": str(tmp_path / "config"),
        "YOLO_VERBOSE": "false",
    }
    call = [sys.executable, "-c", LOAD, str(tmp_path / "yolo" / "data.yaml")]
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


def write_index(dataset, names=("tile-a", "tile-b")):
    properties = [
        {
            "id": name,
            "file": f"test/images/{name}.png",
            "split": "test",
            "source": "a.tif",
            "licence": None,
            "crs": "EPSG:2193",
            "bounds": [1570000, 5180000, 1570015, 5180012],
        }
        for name in names
    ]
    features = [{"type": "Feature", "properties": one, "geometry": None} for one in properties]
    write_json(
        dataset.parent / "index.geojson", {"type": "FeatureCollection", "features": features}
    )


def test_points_come_back_to_their_pixels(dataset, tmp_path):
    write_index(dataset)
    assert export_labels(dataset, "geojson", tmp_path / "cars.geojson") == Exported(2, 3, 1)
    labels = read_labels(tmp_path / "cars.geojson")
    assert isinstance(labels, GroundLabels)
    assert (labels.classes, labels.crs) == (("vehicle",), "EPSG:4326")
    assert [label.ignore for label in labels.labels] == [False, False, False, True]
    pixels = []
    for label in labels.labels:
        east, north = transform(
            "EPSG:4326", "EPSG:2193", *map(list, zip(*label.corners, strict=True))
        )
        # 12.5 cm per pixel; the tile's north-west corner is at (1570000, 5180012).
        pixels.append(
            [
                ((x - 1570000) / 0.125, (5180012 - y) / 0.125)
                for x, y in zip(east, north, strict=True)
            ]
        )
    # 1e-9 degrees are a tenth of a millimetre.
    np.testing.assert_allclose(pixels[:3], [[(64.6, 31.7)], [(20.0, 17.0)], [(2, 65)]], atol=2e-3)
    np.testing.assert_allclose(pixels[3], [(80, 96), (120, 96), (120, 50), (80, 50)], atol=2e-3)


def test_the_point_of_a_cut_vehicle_is_its_own_middle(tmp_path):
    with CocoWriter(tmp_path / "set" / "test", gsd_m=0.125) as writer:
        image = torch.zeros(3, 96, 120, dtype=torch.uint8)
        writer.add(image, "tile-a", [Annotation((0.0, 60.0, 14.0, 70.0), (3.0, 65.0), 0.7)])
    document = json.loads((tmp_path / "set/test/annotations.json").read_text())
    write_index(tmp_path / "set" / "test", ["tile-a"])
    for known, middle in ((True, 3.0), (False, 7.0)):
        if not known:
            del document["annotations"][0]["centre_px"]
            write_json(tmp_path / "set/test/annotations.json", document)
        export_labels(tmp_path / "set" / "test", "geojson", tmp_path / f"{known}.geojson")
        ((place,),) = [one.corners for one in read_labels(tmp_path / f"{known}.geojson").labels]
        (east,), (north,) = transform("EPSG:4326", "EPSG:2193", [place[0]], [place[1]])
        found = (east - 1570000) / 0.125, (5180012 - north) / 0.125
        assert found == pytest.approx((middle, 65.0), abs=2e-3)


def test_images_without_a_place_have_no_geojson(dataset, tmp_path):
    with pytest.raises(ImageryError, match=r"has no place on the map .* `skyproof ground`"):
        export_labels(dataset, "geojson", tmp_path / "x.geojson")
    write_index(dataset, ["tile-a"])
    with pytest.raises(ImageryError, match=r"holds tile-b, which .* does not place on the map"):
        export_labels(dataset, "geojson", tmp_path / "x.geojson")
    (dataset.parent / "index.geojson").write_text(
        '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}}]}'
    )
    with pytest.raises(StoredFileError, match=r"geojson, features\[0\]\.properties: the field id"):
        export_labels(dataset, "geojson", tmp_path / "x.geojson")
    assert not (tmp_path / "x.geojson").exists()


@pytest.mark.parametrize("form", ["yolo", "dota", "coco"])
def test_what_cannot_be_written_leaves_nothing(dataset, tmp_path, form):
    (tmp_path / "there").mkdir()
    with pytest.raises(RunFolderError, match="there exists already"):
        export_labels(dataset, form, tmp_path / "there")
    out = tmp_path / "out"
    with pytest.raises(StoredFileError, match=r"annotations\.json is missing"):
        export_labels(tmp_path, form, out)
    path = dataset / "annotations.json"
    document = json.loads(path.read_text())
    if form != "coco":
        (dataset / "images" / "tile-b.png").unlink()
        with pytest.raises(StoredFileError, match=r"tile-b\.png is missing"):
            export_labels(dataset, form, out)
    for key, value in (("annotations", [{"id": 1}]), ("images", 3), ("categories", [])):
        write_json(path, document | {key: value})
        with pytest.raises(StoredFileError, match=r"annotations\.json, (annotations|images)"):
            export_labels(dataset, form, out)
    write_json(path, document | {"images": [], "annotations": []})
    with pytest.raises(ImageryError, match="holds no images"):
        export_labels(dataset, form, out)
    assert {place.name for place in tmp_path.iterdir()} == {"set", "there"}


@pytest.mark.parametrize("form", ["yolo", "dota", "coco"])
def test_no_file_of_the_machine_gets_into_an_export(dataset, tmp_path, form):
    (tmp_path / "secret.png").write_text("secret")
    path = dataset / "annotations.json"
    document = json.loads(path.read_text())
    for name in ("../../secret.png", str(tmp_path / "secret.png"), "images/link.png"):
        document["images"][0]["file_name"] = name
        write_json(path, document)
        (dataset / "images" / "link.png").unlink(missing_ok=True)
        (dataset / "images" / "link.png").symlink_to(tmp_path / "secret.png")
        with pytest.raises(
            StoredFileError, match=r"inside the same folder|leads out of its folder"
        ):
            export_labels(dataset, form, tmp_path / "out")
    assert {place.name for place in tmp_path.iterdir()} == {"set", "secret.png"}


def test_a_class_that_is_yaml_stays_a_name(dataset, tmp_path):
    path = dataset / "annotations.json"
    document = json.loads(path.read_text())
    document["categories"][0]["name"] = 'a, "b" #c &d *e'
    write_json(path, document)
    export_labels(dataset, "yolo", tmp_path / "yolo")
    assert read_labels(tmp_path / "yolo").classes == ('a, "b" #c &d *e',)
    document["categories"][0]["name"] = "a\ntrain: /etc"
    write_json(path, document)
    with pytest.raises(StoredFileError, match=r"categories\[0\]\.name: expected a plain name"):
        export_labels(dataset, "yolo", tmp_path / "again")


def test_the_command_says_what_a_form_could_not(dataset, tmp_path, capsys):
    assert run(["export", str(dataset), "--format", "yolo", "--out", str(tmp_path / "yolo")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "3 vehicles and 0 ignore regions of 2 images" in told
    assert "1 ignore regions left out" in told
    assert run(["export", str(dataset), "--format", "dota", "--out", str(tmp_path / "dota")]) == 0
    assert "2 vehicles have the upright box" in " ".join(capsys.readouterr().out.split())
    assert run(["export", str(dataset), "--format", "dota", "--out", str(tmp_path / "dota")]) == 2
    assert "not overwritten" in " ".join(capsys.readouterr().err.split())
