"""Whole annotated images: boxes scaled with the image, ignore regions, pixel forms, bad labels."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.errors import ImageryError
from skyproof.imagery.frames import read_frames_folder


def _folder(tmp_path, labels, size=(200, 100), names="car\ntruck\nminibus\n"):
    array = np.full((size[1], size[0], 3), 60, np.uint8)
    array[40:60, 80:120] = 240
    Image.fromarray(array).save(tmp_path / "one.png")
    if labels is not None:
        (tmp_path / "one.txt").write_text(labels)
    if names is not None:
        (tmp_path / "aerial.names").write_text(names)
    return tmp_path


def _read(folder, **options):
    settings = {
        "gsd_m": 0.1,
        "target_gsd_m": 0.2,
        "classes": ["car", "minibus"],
        "border_px": 0.0,
    } | options
    return read_frames_folder(folder, **settings)


def test_boxes_scale_with_the_image(tmp_path):
    data = _read(_folder(tmp_path, "0 0.5 0.5 0.2 0.2\n2 0.25 0.5 0.1 0.1\n1 0.75 0.5 0.1 0.1\n"))
    assert data.image(0).shape == (3, 50, 100)
    assert data.gsd_m == 0.2
    torch.testing.assert_close(
        data.boxes[0], torch.tensor([[40.0, 20, 60, 30], [20, 22.5, 30, 27.5]])
    )
    torch.testing.assert_close(data.ignore[0], torch.tensor([[70.0, 22.5, 80, 27.5]]))
    # The bright block of the picture lies where the first box says.
    inside = data.image(0)[:, 21:29, 41:59].float().mean()
    outside = data.image(0)[:, :18].float().mean()
    assert inside > 230
    assert outside < 65


def test_corners_in_place_of_sizes_are_refused_without_sizes_of_images(tmp_path):
    folder = _folder(tmp_path, "")
    document = {
        "categories": [{"id": 1, "name": "car"}],
        "images": [{"id": 0, "file_name": "one.png"}],
        "annotations": [
            {"id": x, "image_id": 0, "category_id": 1, "bbox": [100 + x, 50, 120 + x, 60]}
            for x in range(10)
        ],
    }
    labels = tmp_path / "labels.json"
    labels.write_text(json.dumps(document))
    with pytest.raises(ImageryError, match=r"10 of 10 boxes .* as if they were left, top, right, "):
        _read(folder, labels=labels, classes=["car"])


def test_border_becomes_ignored(tmp_path):
    # A centre 15 px from the left edge of a 20 px band, and one just inside of it.
    data = _read(
        _folder(tmp_path, "0 0.075 0.5 0.05 0.1\n0 0.11 0.5 0.05 0.1\n"),
        border_px=20.0,
        target_gsd_m=0.1,
    )
    assert data.boxes[0].shape == (1, 4)
    assert float(data.boxes[0][0, 0]) == pytest.approx(17)
    covered = torch.zeros(100, 200, dtype=torch.bool)
    for left, top, right, bottom in data.ignore[0].round().int().tolist()[1:]:
        covered[top:bottom, left:right] = True
    expected = torch.ones(100, 200, dtype=torch.bool)
    expected[20:80, 20:180] = False
    assert torch.equal(covered, expected)
    assert data.ignore[0][0].tolist() == pytest.approx([10, 45, 20, 55])


def test_resampling_does_not_alias(tmp_path):
    folder = _folder(tmp_path, "")
    rows, columns = np.indices((100, 200))
    board = np.where((rows + columns) % 2 == 0, 20, 220).astype(np.uint8)
    Image.fromarray(np.stack([board] * 3, -1)).save(folder / "one.png")
    pixels = _read(folder, target_gsd_m=0.31).image(0).float()
    assert float(pixels.mean()) == pytest.approx(120, abs=2)
    assert float(pixels.std()) < 8


def test_pattern_chooses_images(tmp_path):
    folder = _folder(tmp_path, "")
    Image.new("RGB", (50, 50)).save(folder / "two.png")
    (folder / "two.txt").write_text("")
    assert _read(folder).ids == ["one", "two"]
    assert _read(folder, pattern="tw*").ids == ["two"]
    assert _read(folder, pattern="tw*").boxes[0].shape == (0, 4)


def test_every_pixel_form_gives_the_same(tmp_path):
    yolo = _folder(tmp_path, "0 0.5 0.5 0.2 0.2\n1 0.75 0.5 0.1 0.1\n")
    expected = _read(yolo, classes=["car"])
    dota = tmp_path / "dota"
    dota.mkdir()
    corners = {"car 0": "80 40 120 40 120 60 80 60", "truck 0": "140 45 160 45 160 55 140 55"}
    (dota / "one.txt").write_text("".join(f"{box} {name}\n" for name, box in corners.items()))
    coco = tmp_path / "labels.json"
    boxes = [(1, [80, 40, 40, 20]), (2, [140, 45, 20, 10])]
    document = {
        "categories": [{"id": 1, "name": "car"}, {"id": 2, "name": "truck"}],
        "images": [{"id": 0, "file_name": "one.png", "width": 200, "height": 100}],
        "annotations": [
            {"id": i, "image_id": 0, "category_id": c, "bbox": box}
            for i, (c, box) in enumerate(boxes)
        ],
    }
    coco.write_text(json.dumps(document))
    for labels in (dota, coco):
        data = _read(yolo, labels=labels, classes=["car"])
        torch.testing.assert_close(data.boxes[0], expected.boxes[0])
        torch.testing.assert_close(data.ignore[0], expected.ignore[0])
    document["images"][0] |= {"width": 400}
    coco.write_text(json.dumps(document))
    with pytest.raises(
        ImageryError, match=r"one\.png has 200 x 100 px but .*labels\.json says 400 x 100"
    ):
        _read(yolo, labels=coco, classes=["car"])
    (dota / "one.txt").write_text(
        "80 40 120 40 120 60 80 60 car 0\n240 45 260 45 260 55 240 55 car 0\n"
    )
    with pytest.raises(
        ImageryError, match=r"dota, label 2 of one, has a box outside its image of 200 x 100 px"
    ):
        _read(yolo, labels=dota, classes=["car"])


def test_images_may_lie_in_a_folder_of_their_own(tmp_path):
    (tmp_path / "images").mkdir()
    Image.new("RGB", (200, 100)).save(tmp_path / "images" / "one.png")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "one.txt").write_text("0 0.5 0.5 0.2 0.2")
    (tmp_path / "data.yaml").write_text("names: [car]")
    torch.testing.assert_close(
        _read(tmp_path, classes=["car"]).boxes[0], torch.tensor([[40.0, 20, 60, 30]])
    )


def test_labels_on_the_map_fit_no_frames(tmp_path):
    folder = _folder(tmp_path, "")
    point = {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [1, 2]},
        "properties": {},
    }
    (tmp_path / "x.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [point]})
    )
    with pytest.raises(
        ImageryError, match=r"x\.geojson has labels in map coordinates but frames such as one\.png"
    ):
        _read(folder, labels=tmp_path / "x.geojson")


def test_deep_images_are_refused(tmp_path):
    folder = _folder(tmp_path, "")
    Image.fromarray(np.full((100, 200), 3000, np.uint16)).save(folder / "one.png")
    with pytest.raises(ImageryError, match=r"one\.png has more than 8 bits"):
        _read(folder)


def test_black_and_white_images_are_refused(tmp_path):
    folder = _folder(tmp_path, "")
    Image.fromarray(np.eye(100, 200) > 0).save(folder / "one.png")
    with pytest.raises(ImageryError, match=r"one\.png holds 1-bit values"):
        _read(folder)


@pytest.mark.parametrize(
    ("labels", "names", "options", "message"),
    [
        ("0 1.2 0.5 0.2 0.1\n", "car\nminibus\n", {}, "line 1 has a box outside"),
        ("0 0.5 0.5 0 0.1\n", "car\nminibus\n", {}, "have no width or height"),
        ("0 0.5 0.5 0.1 0.1\n7 0.5 0.5 0.1 0.1\n", "car\nminibus\n", {}, "line 2 has class 7"),
        ("0 0.5 0.5 0.1\n", "car\nminibus\n", {}, "line 1 is not"),
        ("0 a 0.5 0.1 0.1\n", "car\nminibus\n", {}, "line 1 is not"),
        ("0 nan 0.5 0.1 0.1\n", "car\nminibus\n", {}, "line 1 is not"),
        (None, "car\nminibus\n", {}, "no label text"),
        ("", None, {}, "all are empty"),
        ("", "bus\n", {}, "no classes 'car', 'minibus'"),
        ("", "car\nminibus\n", {"pattern": "x*"}, "holds no image"),
    ],
)
def test_bad_folders_raise(tmp_path, labels, names, options, message):
    with pytest.raises(ImageryError, match=message):
        _read(_folder(tmp_path, labels, names=names), **options)


def test_an_image_without_labels_raises(tmp_path):
    folder = _folder(tmp_path, "")
    Image.new("RGB", (50, 50)).save(folder / "two.png")
    with pytest.raises(
        ImageryError, match=r"two\.png has no labels in .*; an image without vehicles needs"
    ):
        _read(folder)


@pytest.mark.parametrize("damage", [slice(0, 4), slice(0, 100)])
def test_damaged_image_raises(tmp_path, damage):
    folder = _folder(tmp_path, "")
    (folder / "one.png").write_bytes((folder / "one.png").read_bytes()[damage])
    with pytest.raises(ImageryError, match=r"one\.png cannot be read"):
        _read(folder).image(0)
