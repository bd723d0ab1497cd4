"""Datasets read lazily: labels at once, pixels when asked for; one sentence for damage."""

import json

import pytest
import torch
from PIL import Image

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import PictureInMemory, Window, made_ahead
from skyproof.errors import StoredFileError
from skyproof.scenes.background_index import BackgroundTile, write_index


def _image(seed, height=20, width=30):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (3, height, width), dtype=torch.uint8, generator=generator)


def _write(folder, source=None):
    with CocoWriter(folder, gsd_m=0.125, source=source) as writer:
        vehicle = Annotation((10.0, 4.0, 18.0, 9.0), (13.5, 6.5), 0.75)
        crowd = Annotation((0.5, 1.5, 4.0, 6.25), (2.0, 4.0), ignore=True)
        writer.add(_image(0), "scene-a", [vehicle, crowd])
        writer.add(_image(1, 24, 16), "scene-b", [])


def test_round_trip(tmp_path):
    _write(tmp_path)
    data = Dataset.open(tmp_path)
    assert data.gsd_m == 0.125
    assert list(data.ids) == ["scene-a", "scene-b"]
    assert data.sizes_px == [(30, 20), (16, 24)]
    assert torch.equal(data.image(0), _image(0))
    assert torch.equal(data.image(1), _image(1, 24, 16))
    assert data.boxes[0].tolist() == [[10, 4, 18, 9]]
    assert data.ignore[0].tolist() == [[0.5, 1.5, 4, 6.25]]
    assert data.boxes[1].shape == (0, 4)
    assert data.ignore[1].shape == (0, 4)


def test_several_images_come_in_the_order_that_was_asked_for(tmp_path):
    _write(tmp_path)
    first, second, third = Dataset.open(tmp_path).images([1, 0, 1])
    assert torch.equal(first, _image(1, 24, 16))
    assert torch.equal(second, _image(0))
    assert torch.equal(third, first)


def test_damage_raises(tmp_path):
    _write(tmp_path)
    (tmp_path / "images" / "scene-b.png").write_bytes(b"gone")
    data = Dataset.open(tmp_path)
    with pytest.raises(StoredFileError, match=r"scene-b\.png"):
        data.image(1)
    with pytest.raises(StoredFileError, match=r"scene-b\.png"):
        data.images([0, 1])
    Image.new("RGB", (16, 16)).save(tmp_path / "images" / "scene-b.png")
    with pytest.raises(StoredFileError, match=r"16 x 16 px, expected are 16 x 24"):
        data.image(1)
    path = tmp_path / "annotations.json"
    path.write_text(path.read_text().replace("gsd_m", "other"))
    with pytest.raises(StoredFileError, match=r"annotations\.json"):
        Dataset.open(tmp_path)


@pytest.mark.parametrize(
    ("list_name", "change", "words"),
    [
        (
            "images",
            {"file_name": "../../secret"},
            r"images\[1\]\.file_name: expected a file inside",
        ),
        ("images", {"file_name": "/etc/passwd"}, r"images\[1\]\.file_name: expected a file inside"),
        ("images", {"file_name": "images/scene-a.png"}, "two images of file_name"),
        ("images", {"scene_id": "a/b"}, r"images\[1\]\.scene_id: expected a plain name"),
        ("images", {"scene_id": "scene-a"}, "two images of scene_id 'scene-a'"),
        ("images", {"id": 1}, "two images of id 1"),
        ("images", {"width": 10**6}, r"images\[1\]\.width: expected a whole number <= 16384"),
        ("annotations", {"bbox": [0, 0, 1e300, 1]}, r"annotations\[1\]\.bbox\[2\]: expected"),
        ("annotations", {"bbox": [0, 0, -1, 1]}, r"annotations\[1\]\.bbox\[2\]: expected"),
        ("annotations", {"bbox": [0, 0, 1]}, r"annotations\[1\]\.bbox: expected a list of length"),
        (
            "annotations",
            {"iscrowd": 0, "bbox": [25, 1, 9, 3]},
            r"has a box \[25.0, 1.0, 9.0, 3.0\] .* outside its image scene-a of 30 x 20 px",
        ),
        ("annotations", {"image_id": 77}, r"annotations\[1\] belongs to image 77"),
        ("annotations", {"visible_fraction": 2}, r"annotations\[1\]\.visible_fraction: expected"),
    ],
)
def test_annotations_that_cannot_be_are_one_sentence(tmp_path, list_name, change, words):
    _write(tmp_path)
    path = tmp_path / "annotations.json"
    document = json.loads(path.read_text())
    document[list_name][1].update(change)
    path.write_text(json.dumps(document))
    with pytest.raises(StoredFileError, match=words) as caught:
        Dataset.open(tmp_path)
    assert str(path) in str(caught.value)


def test_an_image_that_a_link_leads_out_to_is_refused(tmp_path):
    folder = tmp_path / "set"
    _write(folder)
    (tmp_path / "secret").write_text("secret")
    (folder / "images" / "scene-a.png").unlink()
    (folder / "images" / "scene-a.png").symlink_to(tmp_path / "secret")
    with pytest.raises(StoredFileError, match="leads out of its folder"):
        Dataset.open(folder)


def test_visible_fractions_follow_the_boxes(tmp_path):
    image = torch.zeros(3, 8, 8, dtype=torch.uint8)
    with CocoWriter(tmp_path, gsd_m=0.125) as writer:
        cut = Annotation((0.0, 0.0, 2.0, 2.0), (1.0, 1.0), visible_fraction=0.25)
        hidden = Annotation((0.0, 0.0, 8.0, 1.0), (4.0, 0.5), ignore=True)
        whole = Annotation((4.0, 4.0, 6.0, 6.0), (5.0, 5.0))
        writer.add(image, "first", [cut, hidden, whole])
        writer.add(image, "second", [])
    fractions = Dataset.open(tmp_path).visible_fractions
    assert [values.tolist() for values in fractions] == [[0.25, 1.0], []]


def test_who_rendered_it(tmp_path):
    _write(tmp_path)
    data = Dataset.open(tmp_path)
    assert (data.renderer, data.rendering) == ("", {})
    _write(tmp_path, {"renderer": "cycles", "rendering": {"samples": 32}})
    data = Dataset.open(tmp_path)
    assert (data.renderer, data.rendering) == ("cycles", {"samples": 32})
    assert data.origin == f"{tmp_path.name}: rendered by Blender Cycles"
    info = json.loads((tmp_path / "annotations.json").read_text())["info"]
    assert (info["gsd_m"], info["rendering"]) == (0.125, {"samples": 32})
    path = tmp_path / "annotations.json"
    for damaged in ("[]", '{"info": 3}', "{}", "{", '{"info": {"gsd_m": 1, "rendering": 3}}'):
        path.write_text(damaged)
        with pytest.raises(StoredFileError, match=r"annotations\.json"):
            Dataset.open(tmp_path)
    path.unlink()
    with pytest.raises(StoredFileError, match=r"annotations\.json is missing"):
        Dataset.open(tmp_path)


def test_tiles_of_imagery_name_their_sources(tmp_path):
    _write(tmp_path / "train", {"description": "skyproof tiles"})
    sources = ["a.tif", "b.tif", "a.tif", "c.tif", "d.tif"]
    tiles = [
        BackgroundTile(f"t{number}", f"train/images/t{number}.png", "train", 9, 9, source)
        for number, source in enumerate(sources)
    ]
    data = Dataset.open(tmp_path / "train")
    assert data.renderer == ""
    assert data.origin == "train: images of unknown origin"
    write_index(tmp_path, 0.125, tiles)
    assert data.origin == "train: tiles of real imagery (a.tif, b.tif, c.tif and 1 more)"


def test_the_digest_tells_sets_apart_and_not_where_they_lie(tmp_path):
    _write(tmp_path / "here")
    _write(tmp_path / "there")
    digest = Dataset.open(tmp_path / "here").digest
    assert Dataset.open(tmp_path / "there").digest == digest
    path = tmp_path / "there" / "annotations.json"
    written = path.read_text()
    for before, after in (("scene-a", "scene-c"), ("0.125\n", "0.25\n"), ("0.5,", "0.75,")):
        assert before in written
        path.write_text(written.replace(before, after))
        assert Dataset.open(tmp_path / "there").digest != digest, before


def test_sets_in_memory_and_joined_ones_have_no_scenes(tmp_path):
    _write(tmp_path)
    alone = Dataset.of_images([_image(2)], [torch.zeros(1, 4)], gsd_m=0.125)
    both = Dataset.joined([Dataset.open(tmp_path), alone])
    assert list(both.ids) == ["scene-a", "scene-b", "0"]
    assert torch.equal(both.image(2), _image(2))
    assert (both.renderer, both.origin, alone.origin) == ("", "", "")
    with pytest.raises(StoredFileError, match="no scenes"):
        _ = alone.scenes


def test_windows_of_a_picture_are_parts_of_it():
    image = _image(3)
    windows = [Window(0, 0, 5, 7), Window(20, 10, 10, 10)]
    first, second = PictureInMemory(image).windows(windows)
    assert torch.equal(first, image[:, :7, :5])
    assert torch.equal(second, image[:, 10:, 20:])


def test_one_thing_is_made_ahead_and_no_more():
    made = []

    def make(item):
        made.append(item)
        if item == 3:
            raise ValueError("three")
        return -item

    results = made_ahead(make, range(5))
    assert made == []
    assert next(results) == 0
    assert next(results) == -1
    assert len(made) <= 3
    assert next(results) == -2
    with pytest.raises(ValueError, match="three"):
        next(results)
