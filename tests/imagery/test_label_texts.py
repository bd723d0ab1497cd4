"""VisDrone text, Pascal VOC XML, and YOLO text with polygons or without names."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyproof.errors import ImageryError
from skyproof.imagery.frames import read_frames_folder
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import Label
from skyproof.imagery.tiles.sources import find_images
from tests.imagery.made import picture, written

UPRIGHT = ((30.0, 15.0), (50.0, 15.0), (50.0, 25.0), (30.0, 25.0))


# VisDrone

VISDRONE = (
    "30,15,20,10,1,4,0,0\n60,15,20,10,1,9,1,2,\n"
    "100,15,20,10,0,4,0,0\n140, 15, 20, 10, 1, 0, 0, 0\n\n"
)


def test_visdrone(tmp_path):
    written(tmp_path / "annotations" / "one.txt", VISDRONE)
    written(tmp_path / "annotations" / "two.txt", "")
    picture(tmp_path / "images" / "one.jpg")
    labels = read_labels(tmp_path)
    assert len(labels.classes) == 11
    assert labels.classes[3:6] == ("car", "van", "truck")
    assert labels.sizes_px == {"one": (200, 100)}
    assert labels.images["two"] == ()
    car, bus, without_score, region = labels.images["one"]
    assert car == Label("car", UPRIGHT)
    assert (bus.class_name, bus.ignore) == ("bus", False)
    assert (without_score.class_name, without_score.ignore) == ("car", True)
    assert (region.class_name, region.ignore) == ("ignored regions", True)
    for named in ("annotations", "images"):
        assert read_labels(tmp_path / named).images == labels.images
    beside = written(tmp_path / "beside" / "one.txt", "\ufeff" + VISDRONE).parent
    assert read_labels(beside).images["one"] == labels.images["one"]


def test_boxes_of_visdrone_that_are_flat_reach_over_the_edge_or_stand_twice_are_told(tmp_path):
    picture(tmp_path / "one.jpg")
    line = "-10,15,40,10,1,4,0,0\n"
    written(tmp_path / "one.txt", line * 2 + "60,15,4,0,1,4,0,0\n")
    labels = read_labels(tmp_path)
    (label,) = labels.images["one"]
    assert label.bounds == (0, 15, 30, 25)
    twice, flat, cut = labels.notes
    assert flat.startswith("left out 1 box of")
    assert twice.startswith("left out 1 label of")
    assert cut.startswith("cut 2 boxes of")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("30,15,20,10,1,12,0,0", "line 2 has category 12 but VisDrone's are 0 to 11"),
        ("30,15,20,10,1,3.5,0,0", r"line 2 has category 3\.5"),
        ("30,15,20,10,0.8,4,0,0", "line 2 is not 'left,top,.* with a score of 0 or 1"),
        ("30,15,20,10,1,4,0", "line 2 is not"),
        ("30,15,20,nan,1,4,0,0", "line 2 is not"),
        ("300,15,20,10,1,4,0,0", "line 2 has a box outside its image"),
    ],
)
def test_bad_visdrone_lines(tmp_path, line, message):
    picture(tmp_path / "one.jpg")
    written(tmp_path / "one.txt", f"30,15,20,10,1,4,0,0\n{line}\n")
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)


# Pascal VOC


def voc(*objects, filename="one.jpg", size=(200, 100)):
    sides = f"<size><width>{size[0]}</width><height>{size[1]}</height><depth>3</depth></size>"
    inside = "".join(f"<object>{one}</object>" for one in objects)
    head = '<?xml version="1.0" encoding="utf-8"?>\n'
    return f"{head}<annotation><filename>{filename}</filename>{sides}{inside}</annotation>"


def voc_object(box=(31, 16, 50, 25), name="car", more=""):
    sides = zip(("xmin", "ymin", "xmax", "ymax"), box, strict=True)
    return (
        f"<name>{name}</name>{more}<bndbox>"
        + "".join(f"<{side}>{value}</{side}>" for side, value in sides)
        + "</bndbox>"
    )


def test_voc(tmp_path):
    difficult = voc_object((61, 16, 80, 25), "bus", "<difficult>1</difficult>")
    part = voc_object(more="<part><name>roof</name><bndbox><xmin>7</xmin></bndbox></part>")
    text = voc(part, difficult)
    written(tmp_path / "Annotations" / "one.xml", "\ufeff" + text)
    written(tmp_path / "Annotations" / "two.xml", voc(filename="two.jpg", size=(0, 0)))
    written(tmp_path / "Annotations" / "two.tif.aux.xml", "<PAMDataset")
    written(tmp_path / "Annotations" / "about.xml", "<metadata/>")
    written(tmp_path / "ImageSets" / "Main" / "val.txt", "one\ntwo\n")
    for name in ("one", "two"):
        picture(tmp_path / "JPEGImages" / f"{name}.jpg")
    labels = read_labels(tmp_path)
    assert labels.classes == ("bus", "car")
    assert labels.sizes_px == {"one": (200, 100), "two": (200, 100)}
    car, bus = labels.images["one"]
    assert car == Label("car", UPRIGHT)
    assert (bus.class_name, bus.ignore) == ("bus", True)
    assert labels.images["two"] == ()
    for named in ("Annotations", "JPEGImages"):
        assert read_labels(tmp_path / named).images == labels.images
    assert [file.name for file in find_images([tmp_path])] == ["one.jpg", "two.jpg"]
    frames = read_frames_folder(tmp_path, gsd_m=0.125, target_gsd_m=0.125, classes=["car"])
    assert [len(boxes) for boxes in frames.boxes] == [0, 0]  # the border of 40 px is ignored
    assert len(frames.ignore[0]) == 6


def test_the_image_of_a_voc_file_has_its_name_or_the_one_inside(tmp_path):
    text = voc(voc_object(), filename=r"C:\photos\other.jpg")
    written(tmp_path / "one.xml", text)
    assert [*read_labels(tmp_path).images] == ["other"]
    written(tmp_path / "two.xml", text)
    assert [*read_labels(tmp_path).images] == ["one", "two"]
    written(tmp_path / "two.xml", voc(filename="elsewhere.jpg"))
    picture(tmp_path / "one.jpg")
    assert [*read_labels(tmp_path).images] == ["one", "elsewhere"]


def test_voc_boxes_are_cut_and_told_twice(tmp_path):
    row = voc_object((-9, 16, 50, 25))
    written(tmp_path / "one.xml", voc(row, row))
    labels = read_labels(tmp_path)
    assert [label.bounds for label in labels.images["one"]] == [(0, 15, 50, 25)]
    assert len(labels.notes) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (voc(voc_object(name="")), r"one\.xml object 1 has no name"),
        (voc(voc_object(), "<name>car</name>"), "object 2 has no bndbox of numbers"),
        (voc(voc_object((1, 2, "a", 4))), "object 1 has no bndbox of numbers"),
        (voc(voc_object((1, 2, "inf", 4))), "object 1 has no bndbox of numbers"),
        (voc(voc_object((51, 16, 50, 25))), r"1 of 1 boxes .* \(first: one\.xml object 1\)"),
        (voc(voc_object((301, 16, 350, 25))), "object 1 has a box outside its image"),
        (voc(voc_object(more="<difficult>very</difficult>")), "is difficult as 'very', not 0 or 1"),
        ("<annotation>", r"one\.xml is not XML"),
        (b"\xff\xfe<\0", r"one\.xml is not text"),
    ],
)
def test_bad_voc(tmp_path, text, message):
    (tmp_path / "one.xml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)


@pytest.mark.parametrize(
    "entity",
    [
        '<!DOCTYPE a [<!ENTITY e SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE a [<!ENTITY e "ee"><!ENTITY f "&e;&e;&e;&e;">]>',
        '<!doctype a SYSTEM "http://127.0.0.1/a.dtd">',
    ],
)
def test_entities_in_voc_are_refused(tmp_path, entity):
    text = voc(voc_object(name="&e;")).replace("<annotation>", f"{entity}<annotation>", 1)
    written(tmp_path / "one.xml", text)
    with pytest.raises(ImageryError, match=r"one\.xml is not XML that is read \(it defines ent"):
        read_labels(tmp_path)


# YOLO


def test_polygons_and_boxes_of_yolo_in_one_file(tmp_path):
    picture(tmp_path / "one.png")
    written(tmp_path / "data.yaml", "names: [car, bus]\n")
    lines = ["0 0.2 0.2 0.1 0.1", "1 0.15 0.15 0.25 0.2 0.2 0.25"]
    lines += ["0 0.15 0.2 0.2 0.15 0.25 0.2 0.2 0.25", "1 0.3 0.3 0.4 0.3 0.4 0.4 0.35 0.5 0.3 0.4"]
    written(tmp_path / "one.txt", "\n".join(lines))
    box, triangle, oriented, pentagon = read_labels(tmp_path).images["one"]
    for label in (box, triangle):
        assert np.asarray(label.corners) == pytest.approx(np.asarray(UPRIGHT))
    assert oriented.is_oriented
    assert oriented.corners[0] == pytest.approx((30, 20))
    assert pentagon.bounds == pytest.approx((60, 30, 80, 50))
    assert [label.class_name for label in (triangle, pentagon)] == ["bus", "bus"]


@pytest.mark.parametrize("place", [".", "labels", "labels/train"])
def test_one_class_of_yolo_needs_no_names(tmp_path, place):
    folder = tmp_path / place
    images = tmp_path / place.replace("labels", "images")
    for name in ("one", "two"):
        picture(images / f"{name}.png")
        written(folder / f"{name}.txt", "3 0.2 0.2 0.1 0.1\n")
    labels = read_labels(tmp_path)
    assert labels.classes == ("class 3",)
    assert {*labels.images} == {"one", "two"}
    (note,) = labels.notes
    assert note.endswith("lists no names of classes: its only one is called 'class 3'")
    written(folder / "two.txt", "0 0.2 0.2 0.1 0.1\n")
    with pytest.raises(ImageryError, match=r"no names of its 2 classes \(class 0, class 3\); add"):
        read_labels(tmp_path)


def test_dota_comes_before_yolo_that_was_made_of_it(tmp_path):
    picture(tmp_path / "images" / "one.png")
    written(tmp_path / "labels" / "one.txt", "0 0.2 0.2 0.1 0.1\n")
    written(tmp_path / "labelTxt" / "one.txt", "30 15 50 15 50 25 30 25 car 0\n")
    assert read_labels(tmp_path).classes == ("car",)


@pytest.mark.parametrize("place", ["classes.txt", "labels/classes.txt"])
def test_the_class_list_of_labelling_tools_is_read(tmp_path, place):
    picture(tmp_path / "images" / "one.png")
    written(tmp_path / "labels" / "one.txt", "1 0.2 0.2 0.1 0.1\n")
    written(tmp_path / place, "bus\ncar\n")
    labels = read_labels(tmp_path)
    assert labels.classes == ("bus", "car")
    assert [label.class_name for label in labels.images["one"]] == ["car"]


# Any text


_WORDS = st.sampled_from(
    [
        "0",
        "1",
        "-1",
        "0.5",
        "1e9",
        "nan",
        "car",
        ",",
        "30,15,20,10,1,4,0,0",
        "9" * 400,
        "\n",
        "<",
        "&",
    ]
)


@settings(max_examples=300, deadline=None)
@given(
    name=st.sampled_from(["one.txt", "one.xml", "annotations/one.txt", "Annotations/one.xml"]),
    words=st.lists(_WORDS, max_size=12),
    within=st.booleans(),
)
def test_any_text_is_read_or_refused_with_a_sentence(tmp_path_factory, name, words, within):
    folder = tmp_path_factory.mktemp("any")
    picture(folder / "one.png")
    text = " ".join(words)
    if name.endswith("xml") and within:
        text = voc(voc_object((1, 2, text.replace("<", ""), 9), name="car"))
    elif within:
        text = f"30,15,20,10,1,4,0,0\n{text}"
    written(folder / name, text)
    try:
        labels = read_labels(folder)
    except ImageryError as error:
        refused(error, folder)
    else:
        for label in labels.images["one"]:
            left, top, right, bottom = label.bounds
            assert left < right
            assert top < bottom


def refused(error, folder):
    assert str(folder) in str(error)
    assert str(error).endswith(".")
