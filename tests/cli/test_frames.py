"""Annotated frames named on the command line: names, places, labels elsewhere."""

import json

import pytest
import torch
from PIL import Image

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.errors import ConfigurationError, ImageryError
from skyproof.measure.baseline import read_frames
from skyproof.scenes.background_index import BackgroundTile, save_tile, write_index

CLASSES = ["car"]


@pytest.fixture
def folder(tmp_path):
    """Four frames of two flights beside their YOLO labels."""
    place = tmp_path / "kit"
    place.mkdir()
    (place / "my.names").write_text("car\n")
    for name in ("a-1", "a-2", "b-1", "b-2"):
        Image.new("RGB", (200, 100)).save(place / f"{name}.png")
        (place / f"{name}.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    return place


def test_each_argument_is_a_set_and_a_place(folder):
    sets = read_frames([f"{folder}/a*@0.1", f"{folder}@0.25"], CLASSES, 0.125)
    assert [one.name for one in sets] == ["kit/a*", "kit"]
    assert [one.images.ids for one in sets] == [["a-1", "a-2"], ["a-1", "a-2", "b-1", "b-2"]]
    assert [one.places for one in sets] == [("1", "1"), ("1",) * 4]
    assert sets[0].images.image(0).shape == (3, 80, 160)
    assert sets[1].images.image(0).shape == (3, 200, 400)
    assert (
        sets[0].note
        == "real frames, 10.0 cm/px resampled to 12.5 cm/px; vehicles: car; 40 px border ignored"
    )
    assert sets[0].real
    # The centre is inside the border band's inner edge; the box is 20 x 10 px of 10 cm.
    assert sets[0].images.boxes[0].tolist() == [pytest.approx([72, 36, 88, 44])]
    assert len(sets[0].images.ignore[0]) == 4


def test_arguments_of_one_name_are_one_set_of_several_places(folder):
    (one,) = read_frames([f"KIT={folder}/a*@0.1", f"KIT={folder}/b*@0.25"], CLASSES, 0.125)
    assert one.name == "KIT"
    assert one.images.ids == ["a-1", "a-2", "b-1", "b-2"]
    assert one.places == ("1", "1", "2", "2")
    assert "10.0 and 25.0 cm/px" in one.note
    assert one.images.image(2).shape == (3, 200, 400)


def test_every_set_may_have_classes_of_its_own(folder):
    (folder / "my.names").write_text("car\nlorry\n")
    (folder / "b-1.txt").write_text("1 0.5 0.5 0.1 0.1\n")
    cars, lorries, both = read_frames(
        [f"A={folder}@0.125", f"B={folder}@0.125#lorry", f"C={folder}@0.125#car,lorry"],
        CLASSES,
        0.125,
    )
    assert [len(boxes) for boxes in cars.images.boxes] == [1, 1, 0, 1]
    assert [len(boxes) for boxes in lorries.images.boxes] == [0, 0, 1, 0]
    assert [len(boxes) for boxes in both.images.boxes] == [1, 1, 1, 1]
    assert "vehicles: car, lorry;" in both.note


def test_labels_elsewhere(folder, tmp_path):
    document = {
        "categories": [{"id": 1, "name": "car"}],
        "images": [{"id": 0, "file_name": "a-1.png"}],
        "annotations": [{"id": 1, "image_id": 0, "category_id": 1, "bbox": [100, 45, 20, 10]}],
    }
    (tmp_path / "labels.json").write_text(json.dumps(document))
    (one,) = read_frames([f"{folder}/a-1*:{tmp_path}/labels.json@0.125"], CLASSES, 0.125)
    assert one.images.boxes[0].tolist() == [[100, 45, 120, 55]]


def test_a_tiled_set_has_its_sources_as_places(tmp_path):
    tiles = []
    with CocoWriter(tmp_path / "set" / "test", gsd_m=0.125) as writer:
        for number, source in enumerate(["north.tif", "north.tif", "south.tif"]):
            name, image = f"tile-{number}", torch.zeros(3, 96, 96, dtype=torch.uint8)
            tile = BackgroundTile(name, f"test/images/{name}.png", "test", 96, 96, source)
            tiles.append(tile)
            save_tile(tmp_path / "set", tile, image)
            writer.add(image, name, [Annotation((40.0, 42.0, 60.0, 50.0), (50.0, 46.0))])
    write_index(tmp_path / "set", 0.125, tiles)
    (one,) = read_frames([f"{tmp_path}/set/test@0.125"], ["vehicle"], 0.125)
    assert one.places == ("north.tif", "north.tif", "south.tif")
    assert one.real
    # All that reaches into our own tiles is labelled: no border is ignored.
    assert not sum(map(len, one.images.ignore))
    assert "border" not in one.note


def test_rendered_frames_are_not_called_real(folder):
    (folder / "scenes.jsonl").write_text("{}")
    (one,) = read_frames([f"{folder}@0.1"], CLASSES, 0.125)
    assert not one.real
    assert one.note.startswith("rendered frames")


@pytest.mark.parametrize(
    "text", ["{}", "{}@", "{}@x", "{}@0.6", "{}@-0.1", "@0.1", "{}@nan", "KIT=@0.1"]
)
def test_other_forms_are_answered_with_the_right_one(folder, text):
    with pytest.raises(
        ConfigurationError, match=r"--frames expects \[NAME=\]FOLDER\[/PATTERN\]\[:LABELS\]@GSD"
    ):
        read_frames([text.format(folder)], CLASSES, 0.125)


def test_folders_that_are_none(folder):
    with pytest.raises(ConfigurationError, match="kitt is not a folder"):
        read_frames([f"{folder}t@0.1"], CLASSES, 0.125)
    with pytest.raises(ImageryError, match="nothing is missing; give labels as"):
        read_frames([f"{folder}:{folder}/nothing@0.1"], CLASSES, 0.125)
    with pytest.raises(
        ImageryError, match="has no class 'lorry'; choose from those that it names: car"
    ):
        read_frames([f"{folder}@0.1"], ["lorry"], 0.125)
