"""Label files of every form, written by hand: what is read, and the sentence for what cannot be."""

import json
import re
import socket

import geopandas
import numpy as np
import pytest
import rasterio
import shapely

from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import label_files, read_labels
from skyproof.imagery.labels.label import GroundLabels, ImageLabels, Label
from skyproof.imagery.tiles.sources import find_images
from tests.imagery.made import features, noise, picture, shape, written

UPRIGHT = ((30.0, 15.0), (50.0, 15.0), (50.0, 25.0), (30.0, 25.0))


def coco(**changes):
    document = {
        "categories": [{"id": 1, "name": "car"}, {"id": 7, "name": "bus"}],
        "images": [
            {"id": 10, "file_name": "images/one.png", "width": 200, "height": 100},
            {"id": 11, "file_name": "two.jpg"},
        ],
        "annotations": [
            {"id": 1, "image_id": 10, "category_id": 7, "bbox": [30, 15, 20, 10]},
            {"id": 2, "image_id": 10, "category_id": 1, "bbox": [0, 0, 200, 4], "iscrowd": 1},
        ],
    }
    return document | changes


def annotation(**changes):
    return coco(
        annotations=[
            {"id": 5, "image_id": 10, "category_id": 1, "bbox": [30, 15, 20, 10]} | changes
        ]
    )


def test_coco(tmp_path):
    labels = read_labels(written(tmp_path / "labels.json", coco()))
    assert isinstance(labels, ImageLabels)
    assert labels.classes == ("car", "bus")
    assert labels.sizes_px == {"one": (200, 100)}
    assert labels.images == {
        "one": (
            Label("bus", UPRIGHT),
            Label("car", ((0.0, 0.0), (200.0, 0.0), (200.0, 4.0), (0.0, 4.0)), ignore=True),
        ),
        "two": (),
    }


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (
            annotation(bbox=[200, 15, 20, 10]),
            "annotation 5 has a box outside its image of 200 x 100 px",
        ),
        (
            annotation(bbox=[30, 15, 0, 10]),
            r"1 of 1 boxes of .* have no width or height \(first: annotation 5\); write left, ",
        ),
        (annotation(bbox=[30, 15, 20]), "annotation 5 has a bbox of 3 numbers, not 4"),
        (annotation(bbox=[30, 15, 20, 10, 1]), "annotation 5 has a bbox of 5 numbers, not 4"),
        (annotation(bbox=[]), "annotation 5 has neither a bbox nor a segmentation"),
        (annotation(bbox=[30, 15, 20, float("nan")]), "is not JSON"),
        (
            annotation(bbox=[30, 15, 20, 1e300]),
            r"annotations\[0\]\.bbox\[3\]: expected a number <=",
        ),
        (annotation(bbox=None), "annotation 5 has neither a bbox nor a segmentation"),
        (annotation(bbox=7), r"annotations\[0\]\.bbox: expected a list"),
        (annotation(category_id=3), r"category 3 but the file lists 1 \(car\), 7 \(bus\)"),
        (annotation(image_id=3), "annotation 5 belongs to image 3, which is not listed"),
        (coco(annotations=[7]), r"annotations\[0\]: expected an object"),
        (coco(images=[]), "lists no images"),
        (coco(images=[{"id": 1}]), r"images\[0\]: the field file_name is missing"),
        (
            coco(images=[{"id": 1, "file_name": "a/x.png"}, {"id": 2, "file_name": "b/x.png"}]),
            "two images called 'x'",
        ),
        (coco(categories=3), "categories: expected a list"),
        ({"tiles": []}, "neither COCO nor a GeoJSON"),
        ([1], "expected an object, got a list"),
        ('{"images": [],\n"annotations": [}', r"labels\.json is not JSON"),
        ("", r"labels\.json is not JSON"),
    ],
)
def test_bad_json(tmp_path, document, message):
    with pytest.raises(ImageryError, match=message):
        read_labels(written(tmp_path / "labels.json", document))


NAMES = {
    "aerial.names": "car\nbus\n\n",
    "marked.names": "\ufeffcar\nbus\n",
    "marked/data.yaml": "\ufeffnames: [car, bus]\n",
    "list/data.yaml": "train: images\nnames: [car, 'bus']  # two\nnc: 2\n",
    "dashes/data.yaml": 'names:\n- car\n  # a remark\n- "bus"\nnc: 2\n',
    "numbers/data.yaml": "path: .\nnames:\n  1: bus\n  0: car\nval: images\n",
    "braces/data.yaml": "names: {0: car,\n  1: bus}\n",
}


@pytest.mark.parametrize("name", NAMES)
def test_yolo_beside_images(tmp_path, name):
    folder = written(tmp_path / name, NAMES[name]).parent
    picture(folder / "one.png")
    written(folder / "one.txt", "1 0.2 0.2 0.1 0.1\n\n0 0.15 0.15 0.25 0.15 0.25 0.25 0.15 0.25\n")
    picture(folder / "two.JPG")
    written(folder / "two.txt", "")
    written(folder / "readme.txt", "Words.")
    labels = read_labels(folder)
    assert labels.classes == ("car", "bus")
    assert labels.sizes_px == {"one": (200, 100), "two": (200, 100)}
    assert labels.images["two"] == ()
    assert [label.class_name for label in labels.images["one"]] == ["bus", "car"]
    for label in labels.images["one"]:
        assert np.asarray(label.corners) == pytest.approx(np.asarray(UPRIGHT))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("aerial.names", "car\n\ntruck\n"),
        ("data.yaml", "names: [car, '', truck]\n"),
        ("data.yaml", "names:\n- car\n-\n- truck\n"),
        ("data.yaml", "names: {0: car, 1: null, 2: truck}\n"),
    ],
)
def test_an_empty_place_among_the_classes_counts(tmp_path, name, text):
    written(tmp_path / name, text)
    picture(tmp_path / "one.png")
    written(tmp_path / "one.txt", "2 0.2 0.2 0.1 0.1\n1 0.5 0.5 0.1 0.1\n")
    labels = read_labels(tmp_path)
    assert labels.classes == ("car", "class 1", "truck")
    assert [label.class_name for label in labels.images["one"]] == ["truck", "class 1"]


def test_labels_that_stand_twice_count_once_and_boxes_are_cut_with_a_note(tmp_path):
    row = {"image_id": 10, "category_id": 7, "bbox": [-8, 15, 40, 10]}
    document = coco(annotations=[{"id": 1, **row}, {"id": 2, **row}])
    labels = read_labels(written(tmp_path / "labels.json", document))
    (label,) = labels.images["one"]
    assert label.bounds == (0, 15, 32, 25)
    twice, cut = labels.notes
    assert twice == f"left out 1 label of {tmp_path / 'labels.json'} that repeated others"
    assert cut == f"cut 2 boxes of {tmp_path / 'labels.json'} at the edge of the image"
    written(tmp_path / "yolo" / "data.yaml", "names: [car]\n")
    picture(tmp_path / "yolo" / "one.png")
    written(tmp_path / "yolo" / "one.txt", "0 0.2 0.2 0.1 0.1\n" * 3)
    assert len(read_labels(tmp_path / "yolo").images["one"]) == 1
    points = features(*[shape("Point", [1, 2])] * 2)
    labels = read_labels(written(tmp_path / "x.geojson", points))
    assert len(labels.labels) == len(labels.notes) == 1


FORMS = {
    "coco": "left, top, right, bottom; write left, top, width, height in pixels, or cut",
    "visdrone": "left, top, right, bottom; write left, top, width, height in pixels, or cut",
    "yolo": "left, top, right, bottom; write centre x, centre y, width, height as shares",
    "dota": r"of larger images; write x1 y1 \.\.\. x4 y4 in pixels",
    "voc": "of larger images; write xmin, ymin, xmax, ymax in pixels",
}


def boxes(folder, form, lefts, widths=None):
    """Labels of one image of 200 x 100 px: boxes of 20 px height at these positions."""
    rows = [
        (left, 10 + number, left + width, 30 + number)
        for number, (left, width) in enumerate(zip(lefts, widths or [80] * len(lefts), strict=True))
    ]
    picture(folder / "one.png")
    if form == "coco":
        document = coco(
            annotations=[
                {"id": x, "image_id": 10, "category_id": 1, "bbox": [left, top, right - left, 20]}
                for x, (left, top, right, _) in enumerate(rows)
            ]
        )
        return written(folder / "annotations.json", document).parent
    if form == "voc":
        sides = "<xmin>{}</xmin><ymin>{}</ymin><xmax>{}</xmax><ymax>{}</ymax>"
        inside = (f"<name>car</name><bndbox>{sides.format(*row)}</bndbox>" for row in rows)
        text = "".join(f"<object>{one}</object>" for one in inside)
        return written(folder / "one.xml", f"<annotation>{text}</annotation>").parent
    lines = {
        "visdrone": "{0},{1},{6},20,1,4,0,0",
        "yolo": "0 {4} {5} {7} 0.2",
        "dota": "{0} {1} {2} {1} {2} {3} {0} {3} car 0",
    }
    text = "\n".join(
        lines[form].format(
            *(left, top, right, bottom),
            *((left + right) / 400, (top + bottom) / 200, right - left, (right - left) / 200),
        )
        for left, top, right, bottom in rows
    )
    return written(folder / "one.txt", text).parent


@pytest.mark.parametrize("form", FORMS)
def test_boxes_that_mostly_reach_beyond_their_images_are_refused(tmp_path, form):
    folder = boxes(tmp_path / "most", form, [170] * 6 + [50] * 5)
    with pytest.raises(
        ImageryError,
        match=rf"6 of 11 boxes of .* reach beyond their images, as if they were {FORMS[form]}",
    ):
        read_labels(folder)
    for name, lefts in (("half", [170] * 6 + [50] * 6), ("few", [170] * 9)):
        (note,) = [
            note
            for note in read_labels(boxes(tmp_path / name, form, lefts)).notes
            if note.startswith("cut ")
        ]
        assert note.startswith(f"cut {lefts.count(170)} boxes of")


def test_yolo_text_apart_from_its_images_is_told_where_they_lie(tmp_path):
    picture(tmp_path / "photographs" / "one.png")
    written(tmp_path / "texts" / "one.txt", "0 0.2 0.2 0.1 0.1\n")
    with pytest.raises(
        ImageryError,
        match="images beside the texts, or into a folder images beside their folder labels",
    ):
        read_labels(tmp_path / "texts")


def test_ids_as_floats_and_paths_of_windows_are_read(tmp_path):
    plain = coco()
    text = json.dumps(plain)
    other = text.replace('"images/one.png"', '"images\\\\train\\\\one.png"')
    for key in ("id", "image_id", "category_id"):
        other = re.sub(rf'("{key}": \d+)', r"\1.0", other)
    assert other.count(".0") >= 4
    first = read_labels(written(tmp_path / "a.json", text))
    assert read_labels(written(tmp_path / "b.json", other)) == first


def test_a_mark_of_the_byte_order_is_skipped(tmp_path):
    for name, text in (
        ("coco.json", json.dumps(coco())),
        ("points.geojson", json.dumps(features(shape("Point", [1, 2])))),
    ):
        plain = read_labels(written(tmp_path / "plain" / name, text))
        assert read_labels(written(tmp_path / "marked" / name, "\ufeff" + text)) == plain
    for kind, first, line in (
        ("yolo", "data.yaml", "0 .5 .5 .1 .1"),
        ("dota", None, "1 1 9 1 9 9 1 9 car 0"),
    ):
        for mark in ("", "\ufeff"):
            folder = tmp_path / f"{kind}{len(mark)}"
            picture(folder / "one.png")
            written(folder / "one.txt", f"{mark}{line}\n")
            if first:
                written(folder / first, f"{mark}names: [car]\n")
        assert read_labels(tmp_path / f"{kind}1") == read_labels(tmp_path / f"{kind}0")


@pytest.mark.parametrize("named", [".", "images", "labels"])
def test_of_images_and_labels_beside_each_other_either_may_be_named(tmp_path, named):
    written(tmp_path / "data.yaml", "names: [car]\n")
    picture(tmp_path / "images" / "one.tif")
    written(tmp_path / "labels" / "one.txt", "0 0.2 0.2 0.1 0.1")
    assert [*read_labels(tmp_path / named).images] == ["one"]
    if named != "labels":
        assert find_images([tmp_path / named]) == [tmp_path / "images" / "one.tif"]


@pytest.mark.parametrize("form", ["yolo", "dota"])
def test_labels_lie_beside_every_form_of_image_that_is_cut(tmp_path, form):
    folder = tmp_path / form
    (folder / "images").mkdir(parents=True)
    picture(folder / "images" / "sheet.bin.png")
    (folder / "images" / "one.vrt").write_text(
        '<VRTDataset rasterXSize="200" rasterYSize="100"><VRTRasterBand dataType="Byte" band="1">'
        '<SimpleSource><SourceFilename relativeToVRT="1">sheet.bin.png</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(
        folder / "images" / "two.jp2", "w", driver="JP2OpenJPEG", width=200, height=100, count=3,
        dtype="uint8",
    ) as dataset:  # fmt: skip
        dataset.write(noise(100, 200))
    if form == "yolo":
        written(folder / "data.yaml", "names: [car]\n")
    for name in ("one", "two"):
        line = "0 0.2 0.2 0.1 0.1" if form == "yolo" else "30 15 50 15 50 25 30 25 car 0"
        written(folder / ("labels" if form == "yolo" else "labelTxt") / f"{name}.txt", line)
    labels = read_labels(folder)
    assert labels.sizes_px == {"one": (200, 100), "two": (200, 100)}
    for name in ("one", "two"):
        corners = labels.images[name][0].corners
        assert np.asarray(corners) == pytest.approx(np.asarray(UPRIGHT))


def test_yolo_in_a_folder_of_labels(tmp_path):
    written(tmp_path / "data.yaml", "names: [car]\n")
    picture(tmp_path / "images" / "train" / "one.tif")
    written(tmp_path / "labels" / "train" / "one.txt", "0 0.2 0.2 0.1 0.1")
    corners = read_labels(tmp_path).images["one"][0].corners
    assert np.asarray(corners) == pytest.approx(np.asarray(UPRIGHT))
    picture(tmp_path / "images" / "val" / "one.tif")
    written(tmp_path / "labels" / "val" / "one.txt", "")
    with pytest.raises(ImageryError, match="two images called 'one'"):
        read_labels(tmp_path)


def test_splits_with_folders_of_their_own_are_read_from_the_folder_above(tmp_path):
    names = written(tmp_path / "data.yaml", "names: [car]\n")
    written(tmp_path / "README.txt", "An export.\n")
    texts = []
    for split, name in (("train", "one"), ("valid", "two")):
        picture(tmp_path / split / "images" / f"{name}.tif")
        line = "0 0.2 0.2 0.1 0.1"
        texts.append(written(tmp_path / split / "labels" / f"{name}.txt", line))
    assert [*read_labels(tmp_path).images] == ["one", "two"]
    assert {names, *texts} <= {*label_files(tmp_path)}
    assert [file.stem for file in find_images([tmp_path])] == ["one", "two"]
    # Texts beside images come first: what lies below may be a copy.
    picture(tmp_path / "one.tif")
    written(tmp_path / "one.txt", "")
    assert read_labels(tmp_path).images == {"one": ()}


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ("0 1.2 0.5 0.2 0.1\n", "line 1 has a box outside"),
        ("0 0.5 0.5 0 0.1\n", r"1 of 1 boxes .* \(first: one\.txt line 1\)"),
        ("0 0.5 0.5 0.1 0.1\n\n7 0.5 0.5 0.1 0.1\n", "line 3 has class 7 but there are 2 names"),
        ("0.5 0.5 0.5 0.1 0.1\n", r"line 1 has class 0\.5"),
        ("0 0.5 0.5 0.1\n", "line 1 is not 'class cx cy w h'"),
        ("0 a 0.5 0.1 0.1\n", "line 1 is not"),
        ("0 nan 0.5 0.1 0.1\n", "line 1 is not"),
        ("0 0.1 0.1 0.2 0.1 0.2\n", "line 1 is not"),
        ("0 0.1 0.1 0.2 0.1 0.2 0.2 0.1\n", "line 1 is not .* 'class x1 y1"),
        ("-1 0.5 0.5 0.1 0.1\n", "line 1 has class -1"),
        (b"\xff\xfe\x00", r"one\.txt is not text"),
    ],
)
def test_bad_yolo_lines(tmp_path, labels, message):
    picture(tmp_path / "one.png")
    written(tmp_path / "my.names", "car\nbus\n")
    (tmp_path / "one.txt").write_bytes(labels if isinstance(labels, bytes) else labels.encode())
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("my.names", "\n", "names no classes"),
        ("data.yaml", "train: images\n", "names no classes"),
        ("data.yaml", "names:\n  0: car\n  2: bus\n", "names no classes"),
        ("my.names", "car\n", "no label text"),
    ],
)
def test_yolo_folders_without_names_or_labels(tmp_path, name, text, message):
    written(tmp_path / name, text)
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)


def test_two_names_files(tmp_path):
    written(tmp_path / "a.names", "car\n")
    written(tmp_path / "b.names", "car\n")
    with pytest.raises(ImageryError, match=r"2 \.names files"):
        read_labels(tmp_path)


DOTA = (
    "imagesource:GoogleEarth\ngsd:0.125\n"
    "20 10 26 18 22 21 16 13 small-vehicle 0\n30 15 50 15 50 25 30 25 ship 1\n"
)


def test_dota(tmp_path):
    written(tmp_path / "labelTxt" / "one.txt", DOTA)
    written(tmp_path / "labelTxt" / "empty.txt", "")
    labels = read_labels(tmp_path)
    assert labels.classes == ("ship", "small-vehicle")
    oriented = Label("small-vehicle", ((20.0, 10.0), (26.0, 18.0), (22.0, 21.0), (16.0, 13.0)))
    assert labels.images == {"one": (oriented, Label("ship", UPRIGHT, ignore=True)), "empty": ()}
    assert labels.sizes_px == {}
    assert read_labels(tmp_path / "labelTxt") == labels
    picture(tmp_path / "images" / "one.png")
    assert read_labels(tmp_path).sizes_px == {"one": (200, 100)}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("30 15 50 15 50 25 30 car 0", r"one\.txt line 2 is not 'x1 y1"),
        ("30 15 50 15 50 25 30 25 car maybe", "line 2 is not"),
        ("30 15 50 15 50 25 30 inf car 0", "line 2 is not"),
        ("230 15 250 15 250 25 230 25 car 0", "line 2 has a box outside its image of 200 x 100 px"),
    ],
)
def test_bad_dota_lines(tmp_path, line, message):
    written(tmp_path / "one.txt", f"20 10 26 18 22 21 16 13 car 0\n{line}\n")
    picture(tmp_path / "one.png")
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)


def test_text_of_no_known_form(tmp_path):
    written(tmp_path / "one.txt", "car 0.5 0.5 0.1 0.1\n")
    with pytest.raises(
        ImageryError, match=r"not of DOTA, VisDrone or YOLO \(.*one\.txt begins 'car 0\.5"
    ):
        read_labels(tmp_path)
    written(tmp_path / "one.txt", "")
    with pytest.raises(ImageryError, match="all are empty"):
        read_labels(tmp_path)


def crs(name):
    return {"type": "name", "properties": {"name": name}}


RING = [[172.0, -43.0], [172.1, -43.0], [172.1, -43.1], [172.0, -43.1], [172.0, -43.0]]
PENTAGON = [[0, 0], [2, 0], [3, 1], [1, 4], [-1, 1], [0, 0]]


def test_geojson(tmp_path):
    document = features(
        shape("Point", [172.5, -43.5, 12]),
        shape("MultiPoint", [[172.1, -43.2], [172.3, -43.4]]),
        shape("Polygon", [RING]),
        shape("MultiPolygon", [[PENTAGON]]),
    )
    labels = read_labels(written(tmp_path / "cars.geojson", document))
    assert isinstance(labels, GroundLabels)
    assert labels.crs == "EPSG:4326"
    assert labels.classes == ("vehicle",)
    assert [label.corners for label in labels.labels] == [
        ((172.5, -43.5),),
        ((172.1, -43.2),),
        ((172.3, -43.4),),
        tuple(map(tuple, RING[:4])),
        ((-1, 0), (3, 0), (3, 4), (-1, 4)),
    ]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326"),
        ("urn:ogc:def:crs:EPSG::2193", "EPSG:2193"),
        ("EPSG:28992", "EPSG:28992"),
    ],
)
def test_reference_systems(tmp_path, name, expected):
    point = shape("Point", [12.5, 43.5])
    assert read_labels(written(tmp_path / "x.json", features(point, crs=crs(name)))).crs == expected


@pytest.mark.parametrize(
    ("properties", "expected"),
    [
        ({"type": "lorry"}, "lorry"),
        ({"label": "bus", "type": "x"}, "bus"),
        ({"category": 3, "label": "x"}, "3"),
        ({"class": "car", "category": "x"}, "car"),
        ({"class": None, "label": ""}, "vehicle"),
        (None, "vehicle"),
    ],
)
def test_class_of_a_feature(tmp_path, properties, expected):
    document = features(shape("Point", [1, 2]), properties=properties)
    assert read_labels(written(tmp_path / "x.geojson", document)).labels[0].class_name == expected


@pytest.mark.parametrize("form", FORMS)
def test_a_few_boxes_without_size_are_left_out_with_a_note(tmp_path, form):
    # The last pixel of Pascal VOC lies inside the box, and corners of DOTA have no order.
    flat = {"voc": [-1, -9], "dota": [0, 0]}.get(form, [0, -9])
    folder = boxes(tmp_path / "few", form, [50, 20, 60, 40], [80, flat[0], 80, flat[1]])
    labels = read_labels(folder)
    assert [label.bounds[1] for label in labels.images["one"]] == pytest.approx(
        [9, 11] if form == "voc" else [10, 12]
    )
    first = {"coco": "annotation 1", "voc": "one.xml object 2"}.get(form, "one.txt line 2")
    path = folder / "annotations.json" if form == "coco" else folder
    assert f"left out 2 boxes of {path} without width or height (first: {first})" in labels.notes
    folder = boxes(tmp_path / "most", form, [50, 20, 60], [flat[1], flat[0], 80])
    with pytest.raises(ImageryError, match=r"2 of 3 boxes of .* have no width or height"):
        read_labels(folder)


def test_objects_that_enclose_no_ground_are_left_out_with_a_note(tmp_path):
    line = [[1, 1], [1, 2], [1, 3], [1, 1]]
    whole = [shape("Polygon", [RING]), shape("Point", [1, 2])]
    path = tmp_path / "x.geojson"
    for nothing in (None, shape("Polygon", [])):
        labels = read_labels(written(path, features(*whole, nothing)))
        assert [len(label.corners) for label in labels.labels] == [4, 1]
        assert "(first: object 3)" in labels.notes[0]
    labels = read_labels(written(path, features(*whole, shape("Polygon", [line]))))
    assert [len(label.corners) for label in labels.labels] == [4, 1]
    (note,) = labels.notes
    assert note == f"left out 1 box of {path} without width or height (first: object 3)"
    written(path, features(shape("Polygon", [line]), whole[0], shape("Polygon", [line])))
    with pytest.raises(ImageryError, match=r"2 of 3 boxes .* \(first: object 1\); write outlines"):
        read_labels(path)


def test_a_feature_may_ask_to_be_ignored(tmp_path):
    document = features(shape("Polygon", [RING]), properties={"class": "car", "ignore": True})
    assert read_labels(written(tmp_path / "x.geojson", document)).labels[0].ignore


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (features(), "holds no objects"),
        (
            features(shape("Point", [1, 2]), shape("LineString", [[1, 2], [3, 4]])),
            "object 2 is neither a point",
        ),
        (features(None), "1 of 1 boxes .* object 1"),
        (features(shape("Point", [1])), "1 of 1 boxes .* object 1"),
        (features(shape("Point", [1, float("nan")])), "is not JSON"),
        (features(shape("Point", [1, 1e300])), "object 1 is neither"),
        (features(shape("Polygon", [])), "1 of 1 boxes .* object 1"),
        (features(shape("Polygon", [[[1, 1], [1, 1]]])), "1 of 1 boxes .* object 1"),
        (
            features(shape("Point", [1576000, 5180000])),
            r"object 1 is at 1\.576e\+06, 5\.18e\+06, which is no longitude",
        ),
        (features(shape("Point", [1, 2]), crs=crs("EPSG:999999")), "reference system"),
        (features(shape("Point", [1, 2]), crs={"type": "link"}), "reference system"),
        (
            features(shape("Point", [1, 2]), properties={"class": ["car", "van"]}),
            "object 1 has several values as its 'class'",
        ),
    ],
)
def test_bad_geojson(tmp_path, document, message):
    with pytest.raises(ImageryError, match=message):
        read_labels(written(tmp_path / "x.geojson", document))


@pytest.mark.parametrize(
    "member",
    [
        {"type": "link", "properties": {"href": "{}", "type": "ogcwkt"}},
        {"type": "link", "properties": {"name": "EPSG:2193", "href": "{}"}},
        {"type": "URL", "properties": {"url": "{}"}},
        crs("{}"),
        crs(" {}"),
        crs("/vsicurl/{}"),
        "{}",
        7,
    ],
)
def test_a_reference_system_is_not_fetched(tmp_path, member):
    document = json.dumps(features(shape("Point", [1, 2]), crs=member))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/system"
        file = written(tmp_path / "x.geojson", document.replace("{}", address))
        with pytest.raises(ImageryError, match="reference system"):
            read_labels(file)
        with pytest.raises(TimeoutError):
            server.accept()


def test_paths_that_hold_no_labels(tmp_path):
    with pytest.raises(ImageryError, match=r"nowhere is missing; give labels as COCO"):
        read_labels(tmp_path / "nowhere")
    with pytest.raises(ImageryError, match=r"x\.csv is not of a known label form"):
        read_labels(written(tmp_path / "x.csv", "a,b"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImageryError, match="holds no labels"):
        read_labels(tmp_path / "empty")
    (tmp_path / "x.json").write_bytes(b"\xff\xff")
    with pytest.raises(ImageryError, match="is not JSON"):
        read_labels(tmp_path / "x.json")


def test_geopackage(tmp_path):
    shapes = [shapely.Point(1576000, 5180000), shapely.box(1576010, 5180000, 1576014, 5180002)]
    table = {"class": ["car", None], "ignore": [False, True]}
    frame = geopandas.GeoDataFrame(table, geometry=shapes, crs="EPSG:2193")
    frame.to_file(tmp_path / "cars.gpkg")
    labels = read_labels(tmp_path / "cars.gpkg")
    assert isinstance(labels, GroundLabels)
    assert (labels.crs, labels.classes) == ("EPSG:2193", ("car", "vehicle"))
    point, outline = labels.labels
    assert point == Label("car", ((1576000.0, 5180000.0),))
    assert outline.ignore
    assert {*outline.corners} == {(x, y) for x in (1576010, 1576014) for y in (5180000, 5180002)}


def test_shapefile(tmp_path):
    # It has neither truth values nor long names of columns, and lies in five files.
    shapes = [shapely.Point(1576000, 5180000), shapely.Point(1576010, 5180000)]
    table = {"category": [3, 4], "ignore": [0, 1]}
    geopandas.GeoDataFrame(table, geometry=shapes, crs="EPSG:2193").to_file(tmp_path / "cars.shp")
    labels = read_labels(tmp_path / "cars.shp")
    assert labels.crs == "EPSG:2193"
    assert labels.labels == (
        Label("3", ((1576000.0, 5180000.0),)),
        Label("4", ((1576010.0, 5180000.0),), ignore=True),
    )


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_bad_vector_files(tmp_path):
    with pytest.raises(ImageryError, match=r"x\.gpkg is no \.gpkg file inside"):
        read_labels(written(tmp_path / "x.gpkg", "hello"))
    frame = geopandas.GeoDataFrame(geometry=[shapely.Point(1, 2)])
    frame.to_file(tmp_path / "nowhere.shp")
    with pytest.raises(ImageryError, match=r"nowhere\.shp names no reference system"):
        read_labels(tmp_path / "nowhere.shp")
    for layer in ("cars", "buses"):
        frame.set_crs("EPSG:2193").to_file(tmp_path / "two.gpkg", layer=layer)
    with pytest.raises(ImageryError, match=r"two\.gpkg holds 2 layers"):
        read_labels(tmp_path / "two.gpkg")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("names: [car\n", r"data\.yaml is not YAML"),
        ("names: " + "[" * 20_000, r"data\.yaml is not YAML"),
        ("names: [!!python/object/apply:os.system [touch ran]]\n", "names no classes"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nnames: [*b, *b]\n", "aliases, .*, which are not read"),
    ],
)
def test_hostile_yaml_is_refused_and_runs_nothing(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    picture(tmp_path / "one.png")
    written(tmp_path / "one.txt", "0 0.5 0.5 0.1 0.1\n")
    written(tmp_path / "data.yaml", text)
    with pytest.raises(ImageryError, match=message):
        read_labels(tmp_path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("named", [".", "images", "labels"])
def test_the_files_that_decide_the_labels_are_listed(tmp_path, named):
    names = written(tmp_path / "town.names", "car\n")
    picture(tmp_path / "images" / "train" / "one.tif")
    (tmp_path / "labels" / "train").mkdir(parents=True)
    text = written(tmp_path / "labels" / "train" / "one.txt", "0 0.2 0.2 0.1 0.1")
    assert [file.resolve() for file in label_files(tmp_path / named)] == [text, names]


def test_xml_files_decide_labels(tmp_path):
    file = written(tmp_path / "Annotations" / "one.xml", "<annotation/>")
    assert label_files(tmp_path) == [file]
