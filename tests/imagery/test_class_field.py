"""The field of a vector file that names classes: found, asked for, or chosen with FIELD=CLASS."""

import geopandas
import pytest
import shapely

from skyproof.errors import ImageryError
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.labels.label import require_classes
from skyproof.imagery.settings import LabelSettings
from skyproof.imagery.tiles.placed_labels import vehicle_classes
from tests.imagery.made import features, shape, written

KINDS = ["car", "tree", "car", "van"]


def objects(**fields):
    """Points with one value of every field each."""
    rows = [dict(zip(fields, values, strict=True)) for values in zip(*fields.values(), strict=True)]
    points = [shape("Point", [number, 2]) for number in range(len(rows))]
    return features(*points, properties=rows)


def names(labels):
    return [label.class_name for label in labels.labels]


@pytest.mark.parametrize(
    "field",
    [
        "type_id",
        "CLASS",
        "Class",
        "class_name",
        "Class Name",
        "category_n",
        "vehicle_ty",
        "label-id",
    ],
)
def test_usual_names_are_found_with_a_note_whatever_their_case(tmp_path, field):
    path = written(tmp_path / "x.geojson", objects(**{"made by": ["a"] * 4, field: KINDS}))
    labels = read_labels(path)
    assert names(labels) == KINDS
    assert labels.notes == (f"the classes of {path} are read from its field {field!r}",)


def test_documented_names_need_no_note(tmp_path):
    document = objects(remark=["a", "b", "c", "d"], label=KINDS)
    assert read_labels(written(tmp_path / "x.geojson", document)).notes == ()


def test_numbers_may_name_classes(tmp_path):
    document = objects(type_id=[18, 73, 18, None], cat_id=["1", "1", "1", "1"])
    labels = read_labels(written(tmp_path / "x.geojson", document), ["18"])
    assert names(labels) == ["18", "73", "18", "vehicle"]


def test_a_shapefile_in_capitals(tmp_path):
    table = {"CLASS": KINDS, "IGNORE": [0, 0, 1, 0]}
    points = [shapely.Point(1576000 + number, 5180000) for number in range(4)]
    geopandas.GeoDataFrame(table, geometry=points, crs="EPSG:2193").to_file(tmp_path / "x.shp")
    labels = read_labels(tmp_path / "x.shp")
    assert names(labels) == KINDS
    assert [label.ignore for label in labels.labels] == [False, False, True, False]


def test_of_several_usual_fields_the_one_counts_that_tells_objects_apart(tmp_path):
    path = written(tmp_path / "x.geojson", objects(**{"class": ["object"] * 4}, type=KINDS))
    labels = read_labels(path)
    assert names(labels) == KINDS
    assert labels.notes == (
        f"the classes of {path} are read from its field 'type' and, where it is empty, from "
        "'class'",
    )
    assert names(read_labels(path, ["object"])) == ["object"] * 4


def test_an_object_takes_its_class_from_the_field_that_it_has(tmp_path):
    document = objects(Class=["car", None, "", None], category=[None, "bus", "van", None])
    labels = read_labels(written(tmp_path / "x.geojson", document))
    assert names(labels) == ["car", "bus", "van", "vehicle"]


def test_the_wanted_classes_tell_the_field(tmp_path):
    document = objects(kind=KINDS, owner=["A", "B", "B", "A"], fid=[1, 2, 3, 4])
    path = written(tmp_path / "x.geojson", document)
    labels = read_labels(path, ["car", "van"])
    assert names(labels) == KINDS
    assert labels.notes == (f"the classes of {path} are read from its field 'kind'",)
    labels = read_labels(path, ["owner=B"])
    assert names(labels) == ["owner=A", "owner=B", "owner=B", "owner=A"]
    assert names(read_labels(path, ["fid=3"]))[2] == "fid=3"


@pytest.mark.parametrize("wanted", [(), ("lorry",)])
def test_an_unknown_field_is_asked_for(tmp_path, wanted):
    document = objects(kind=KINDS, owner=["A", "B", "C", "D"], fid=[1, 2, 3, 4])
    path = written(tmp_path / "x.geojson", document)
    with pytest.raises(
        ImageryError,
        match=r"names the classes: kind \(car, tree, van\), owner \(A, B, C, ...\), "
        r"fid \(1, 2, 3, ...\); .* --labels\.classes kind=car\), or say --labels\.classes vehicle",
    ):
        read_labels(path, wanted)
    labels = read_labels(path, ["vehicle"])
    assert names(labels) == ["vehicle"] * 4
    assert "every object counts as a vehicle" in labels.notes[0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": KINDS, "fid": [1, 2, 3, 4]}, "no field 'colour'; .* it has: kind, fid"),
        ({"class": KINDS}, "no field 'colour'; .* it has: class"),
        ({"class": KINDS, "colour": [""] * 4}, "no field 'colour' with values; .* it has: class"),
        ({"colour": [""] * 4}, "no field 'colour' with values; .* it has: none"),
    ],
)
def test_a_missing_field_is_told_with_those_that_there_are(tmp_path, fields, message):
    path = written(tmp_path / "x.geojson", objects(**fields))
    with pytest.raises(ImageryError, match=rf"x\.geojson has {message}\.$"):
        read_labels(path, ["colour=car"])


def test_a_class_may_hold_an_equals_sign(tmp_path):
    path = written(tmp_path / "x.geojson", objects(kind=["size=1", "size=2", "size=1", "none"]))
    assert read_labels(path, ["size=1"]).classes == ("size=1", "size=2", "none")


@pytest.mark.parametrize(
    ("wanted", "role"),
    [
        ((), "'vehicle'"),
        (("car",), "ignore regions"),
        (("class=car",), "ignore regions"),
        (("car", "vehicle"), "'vehicle'"),
    ],
)
def test_objects_that_name_no_class_are_told(tmp_path, wanted, role):
    kinds = ["car", None, "", "car", None]
    regions = [False, False, False, False, True]
    path = written(tmp_path / "x.geojson", objects(**{"class": kinds, "ignore": regions}))
    labels = read_labels(path, wanted)
    assert labels.notes == (f"objects of {path} that name no class (2 of 5) count as {role}",)
    assert names(labels).count("vehicle") == 3


def test_the_list_of_classes_names_the_field_that_they_come_from(tmp_path):
    path = written(tmp_path / "x.geojson", objects(type_id=[18, 73, 18, 73], cat=["1"] * 4))
    labels = read_labels(path)
    with pytest.raises(ImageryError, match=r"the classes 18, 73 \(from its field 'type_id'\);"):
        vehicle_classes(labels, LabelSettings(path))
    with pytest.raises(ImageryError, match=r"it names: 18, 73 \(from its field 'type_id'\)\.$"):
        require_classes(labels, ["car"], "labels")
    labels = read_labels(written(path, objects(type_id=[18, 73, 18, None])))
    with pytest.raises(ImageryError, match=r"'type_id'; where it is empty, vehicle\)"):
        require_classes(labels, ["car"], "labels")


def test_two_fields_that_hold_the_wanted_classes_for_different_objects_are_asked_about(tmp_path):
    other = ["tree", "car", "car", "van"]
    path = written(tmp_path / "x.geojson", objects(**{"class": KINDS}, label=other))
    with pytest.raises(ImageryError, match=r"class \(car, tree, van\), label \(tree, car, van\)"):
        read_labels(path, ["car"])
    assert names(read_labels(path, ["van"])) == KINDS
    assert names(read_labels(path, ["label=car"]))[1] == "label=car"


def test_a_field_that_is_equal_everywhere_is_no_class_and_is_told(tmp_path):
    path = written(tmp_path / "x.geojson", objects(source=["survey"] * 4, id=[4, 5, 6, 7]))
    labels = read_labels(path)
    assert labels.classes == ("vehicle",)
    assert labels.notes == (
        f"no field of {path} names classes, as far as known: every object counts as a vehicle "
        "(fields: source, id)",
    )
    path = written(tmp_path / "y.geojson", objects(type=["Feature"] * 4, kind=KINDS))
    (note,) = read_labels(path).notes
    assert note.endswith("from its field 'type': every object is called 'Feature'")


def test_parts_of_an_object_count_each_and_are_told(tmp_path):
    square = [[[1, 1], [2, 1], [2, 2], [1, 2], [1, 1]]]
    other = [[[5, 1], [6, 1], [6, 2], [5, 2], [5, 1]]]
    document = features(shape("MultiPolygon", [square, other]), shape("Polygon", square))
    path = written(tmp_path / "x.geojson", document)
    labels = read_labels(path)
    assert len(labels.labels) == 2
    assert labels.notes[0] == f"counted the 2 parts of 1 object of {path} as one label each"


def layers(path, **frames):
    for name, (geometry, table) in frames.items():
        frame = geopandas.GeoDataFrame(table, geometry=[geometry], crs="EPSG:2193")
        frame.to_file(path, layer=name)
    return path


POINT, BOX = shapely.Point(1576000, 5180000), shapely.box(1576010, 5180000, 1576014, 5180002)
LINE = shapely.LineString([(1576000, 5180000), (1576010, 5180000)])


def test_the_one_layer_that_can_be_labels_is_read_with_a_note(tmp_path):
    path = layers(tmp_path / "x.gpkg", roads=(LINE, {"class": ["road"]}), cars=(BOX, {"n": [1]}))
    labels = read_labels(path)
    assert len(labels.labels) == 1
    assert labels.notes[0] == f"of {path} the layer 'cars' is read, and not roads"
    path = layers(tmp_path / "y.gpkg", area=(BOX, {"n": [1]}), cars=(POINT, {"class": ["car"]}))
    assert read_labels(path).classes == ("car",)
    path = layers(tmp_path / "z.gpkg", a=(BOX, {"what": ["car"]}), b=(BOX, {"n": [1]}))
    with pytest.raises(ImageryError, match=r"2 layers that may be labels \(a, b\); .* z\.gpkg a\)"):
        read_labels(path)
    assert read_labels(path, ["what=car"]).classes == ("what=car",)
