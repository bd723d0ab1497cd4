"""Labels on the way to tiles: through transforms and map coordinates, at borders, out of place."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine, from_origin
from rasterio.warp import transform as transform_places

from skyproof.datasets.dataset import Dataset
from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import GroundLabels, ImageLabels, Label
from skyproof.imagery.settings import LabelSettings
from tests.imagery.made import all_tiles, noise, tile, write_image

NZTM = "EPSG:2193"
EAST, NORTH = 1_550_000.0, 5_190_000.0
PLACE = {"crs": NZTM, "transform": from_origin(EAST, NORTH, 0.125, 0.125)}
WHERE = Path("labels.geojson")


def box(left, top, right, bottom, name="car", ignore=False):
    left, top, right, bottom = map(float, (left, top, right, bottom))
    return Label(name, ((left, top), (right, top), (right, bottom), (left, bottom)), ignore)


def pixels(*labels, stem="a", classes=("car", "truck"), sizes=None):
    return ImageLabels(classes, {stem: labels}, sizes or {})


def ground(*points, crs=NZTM):
    return GroundLabels(("vehicle",), tuple(Label("vehicle", (point,)) for point in points), crs)


def boxes(folder, kind):
    """Per tile id its vehicles (`iscrowd` 0) or ignore regions (1) as xyxy."""
    found = {}
    for split in ("train", "validation", "attack", "test"):
        document = json.loads((folder / split / "annotations.json").read_text())
        names = {image["id"]: image["scene_id"] for image in document["images"]}
        for row in document["annotations"]:
            if row["iscrowd"] == kind:
                x, y, width, height = row["bbox"]
                found.setdefault(names[row["image_id"]], []).append(
                    (round(x, 3), round(y, 3), round(x + width, 3), round(y + height, 3))
                )
    return found


def one_image(tmp_path, labels, **settings):
    """One image of 256 x 128 px, eight tiles of 64 px."""
    write_image(tmp_path / "a.tif", noise(128, 256))
    given = {"classes": ("car",), **settings}
    _, record = tile(
        [tmp_path / "a.tif"],
        tmp_path / "set",
        source_gsd_m=0.125,
        labels=(labels, LabelSettings(WHERE, **given)),
    )
    return record


def test_a_vehicle_counts_where_its_centre_lies_and_is_ignored_beside(tmp_path):
    record = one_image(tmp_path, pixels(box(50, 10, 70, 20), box(100, 80, 110, 90)))
    assert boxes(tmp_path / "set", 0) == {
        "a-00000-00000": [(50, 10, 64, 20)],
        "a-00064-00064": [(36, 16, 46, 26)],
    }
    assert boxes(tmp_path / "set", 1) == {"a-00000-00064": [(0, 10, 6, 20)]}
    rows = [
        row
        for file in (tmp_path / "set").glob("*/annotations.json")
        for row in json.loads(file.read_text())["annotations"]
        if row["bbox"][0] == 50
    ]
    assert rows[0]["centre_px"] == [60, 15]
    assert rows[0]["visible_fraction"] == pytest.approx(0.7)
    # All tiles stay, those without a vehicle as well.
    assert sum(count["tiles"] for count in record.counts.values()) == 8
    assert sum(len(Dataset.open(tmp_path / "set" / split)) for split in record.counts) == 8


def test_other_classes_and_what_the_file_ignores_become_ignore_regions(tmp_path):
    one_image(tmp_path, pixels(box(10, 10, 20, 20, "truck"), box(30, 30, 40, 40, ignore=True)))
    assert boxes(tmp_path / "set", 0) == {}
    assert sorted(boxes(tmp_path / "set", 1)["a-00000-00000"]) == [
        (10, 10, 20, 20),
        (30, 30, 40, 40),
    ]


def test_pixel_labels_follow_a_turned_image(tmp_path):
    # A bright square in the picture must lie in its box, whatever the image's turn and scale.
    array = np.full((3, 600, 600), 40, np.uint8)
    array[:, 300:330, 250:290] = 240
    affine = Affine.translation(EAST, NORTH) * Affine.rotation(25) * Affine.scale(0.1, -0.1)
    write_image(tmp_path / "a.tif", array, crs=NZTM, transform=affine)
    labels = pixels(box(250, 300, 290, 330)), LabelSettings(WHERE, ("car",))
    backgrounds, _ = tile([tmp_path / "a.tif"], tmp_path / "set", labels=labels, size_px=128)
    (tile_id, ((left, top, right, bottom),)) = next(iter(boxes(tmp_path / "set", 0).items()))
    bright = (backgrounds.pixels(tile_id)[0] > 140).numpy()
    rows, columns = np.nonzero(bright)
    found = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    expected = max(left, 0), max(top, 0), min(right, 128), min(bottom, 128)
    assert found == pytest.approx(expected, abs=1.5)


@pytest.mark.parametrize("crs", [NZTM, "EPSG:4326"])
def test_ground_points_of_two_systems(tmp_path, crs):
    write_image(tmp_path / "a.tif", noise(256, 256), **PLACE)
    xs, ys = [EAST + 10.0, EAST + 21.0, EAST + 500], [NORTH - 5.0, NORTH - 21.0, NORTH]
    if crs != NZTM:
        xs, ys = transform_places(NZTM, crs, xs, ys)
    labels = ground(*zip(xs, ys, strict=True), crs=crs), LabelSettings(WHERE)
    _, record = tile([tmp_path / "a.tif"], tmp_path / "set", labels=labels)
    # Tiles begin at the image's corner: 10 m is pixel 80, in the second tile pixel 16; the box is
    # 32 px wide.
    found = boxes(tmp_path / "set", 0)
    assert len(found) == 2
    expected = {
        f"epsg2193-e{int(EAST) + 8}-n{int(NORTH)}": (0, 24, 32, 56),
        f"epsg2193-e{int(EAST) + 16}-n{int(NORTH) - 16}": (24, 24, 56, 56),
    }
    for tile_id, values in expected.items():
        assert found[tile_id][0] == pytest.approx(values, abs=0.02)
    assert any("left out 1 label of labels.geojson outside" in note for note in record.notes)


def test_an_image_without_any_label_on_the_ground_is_named(tmp_path):
    write_image(tmp_path / "a.tif", noise(128, 128), **PLACE)
    beside = from_origin(EAST + 400.0, NORTH, 0.125, 0.125)
    write_image(tmp_path / "b.tif", noise(128, 128), **{**PLACE, "transform": beside})
    labels = ground((EAST + 5.0, NORTH - 5.0)), LabelSettings(WHERE)
    _, record = tile([tmp_path], tmp_path / "set", labels=labels)
    (note,) = [note for note in record.notes if "free of vehicles" in note]
    assert "lies in b.tif of 2, which counts" in note
    both = ground((EAST + 5.0, NORTH - 5.0), (EAST + 405.0, NORTH - 5.0)), LabelSettings(WHERE)
    _, record = tile([tmp_path], tmp_path / "both", labels=both)
    assert not any("free of vehicles" in note for note in record.notes)


def test_boxes_that_mostly_reach_beyond_images_are_refused_whoever_states_their_size(tmp_path):
    beyond = [box(10 + x, 10, 300, 90) for x in range(6)]
    inside = [box(10 + x, 10, 20 + x, 20) for x in range(5)]
    with pytest.raises(ImageryError, match=r"6 of 11 boxes of labels\.geojson reach beyond their"):
        one_image(tmp_path, pixels(*beyond, *inside))
    one_image(tmp_path, pixels(*beyond[1:], *inside))
    with pytest.raises(ImageryError, match=r"has 256 x 128 px but labels\.geojson says 400 x 128"):
        one_image(tmp_path, pixels(*beyond, *inside, sizes={"a": (400, 128)}))


def test_of_overlapping_sources_only_the_one_shown_labels(tmp_path):
    for stem in ("a", "b"):
        write_image(tmp_path / f"{stem}.tif", noise(128, 128), **PLACE)
    labels = ImageLabels(("car",), {"a": (box(10, 10, 20, 20),), "b": (box(11, 11, 21, 21),)}, {})
    tile([tmp_path], tmp_path / "set", labels=(labels, LabelSettings(WHERE)))
    assert [*boxes(tmp_path / "set", 0).values()] == [[(10, 10, 20, 20)]]


def test_an_image_nobody_labelled_is_ignored_as_a_whole(tmp_path):
    write_image(tmp_path / "a.tif", noise(64, 256))
    write_image(tmp_path / "b.tif", noise(64, 128))
    labels = pixels(box(10, 10, 20, 20)), LabelSettings(WHERE, ("car",))
    backgrounds, record = tile([tmp_path], tmp_path / "set", source_gsd_m=0.125, labels=labels)
    ignored = boxes(tmp_path / "set", 1)
    assert {one.id for one in all_tiles(backgrounds) if one.source == "b.tif"} == {*ignored}
    assert {tuple(*found) for found in ignored.values()} == {(0, 0, 64, 64)}
    assert any(note.startswith("b.tif: no labels") for note in record.notes)


def test_labels_on_the_map_say_nothing_of_an_image_without_a_place(tmp_path):
    write_image(tmp_path / "a.tif", noise(128, 128), **PLACE)
    write_image(tmp_path / "b.tif", noise(64, 128))
    labels = ground((EAST + 5.0, NORTH - 5.0)), LabelSettings(WHERE)
    backgrounds, record = tile([tmp_path], tmp_path / "set", source_gsd_m=0.125, labels=labels)
    bare = {one.id for one in all_tiles(backgrounds) if one.source == "b.tif"}
    ignored = boxes(tmp_path / "set", 1)
    assert len(bare) == 2
    assert {name: ignored[name] for name in bare} == {name: [(0, 0, 64, 64)] for name in bare}
    assert [note for note in record.notes if note.startswith("b.tif: no labels, so nothing is")]
    assert len(boxes(tmp_path / "set", 0)) == 1


@pytest.mark.parametrize(
    ("labels", "settings", "message"),
    [
        (
            pixels(box(0, 0, 5, 5)),
            {"classes": ("lorry",)},
            "no class 'lorry'; choose from those that it names: car, truck",
        ),
        (pixels(box(0, 0, 5, 5)), {"classes": ()}, r"--labels\.classes"),
        (pixels(box(900, 900, 910, 910)), {}, "None of the 1 labels"),
        (pixels(box(0, 0, 5, 5), stem="z"), {}, "none of these is among the imagery"),
        (pixels(box(0, 0, 5, 5), sizes={"a": (100, 100)}), {}, "says 100 x 100"),
        (ground((172.0, -43.0), crs="EPSG:4326"), {"classes": ()}, "no image says where it lies"),
    ],
)
def test_labels_that_do_not_fit_are_one_clear_sentence(tmp_path, labels, settings, message):
    with pytest.raises(ImageryError, match=message) as caught:
        one_image(tmp_path, labels, **settings)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "set").exists()


def test_ground_labels_of_the_wrong_system(tmp_path):
    write_image(tmp_path / "a.tif", noise(256, 256), **PLACE)
    # Coordinates of NZTM that say they are UTM.
    labels = ground((EAST + 10, NORTH - 5), (EAST + 20, NORTH - 5), crs="EPSG:32633")
    with pytest.raises(
        ImageryError, match=r"None of the 2 labels .* check their reference system \(EPSG:32633"
    ):
        tile([tmp_path / "a.tif"], tmp_path / "set", labels=(labels, LabelSettings(WHERE)))


def turned(x, y, length, width, angle_deg, first=0, mirrored=False):
    """An oriented label in image pixels, nose at an angle from right towards up."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    u, v = length / 2, width / 2
    around = [(u, v), (u, -v), (-u, -v), (-u, v)]
    corners = [(x + c * a - s * b, y - s * a - c * b) for a, b in around]
    corners = corners[first:] + corners[:first]
    return Label("car", tuple(reversed(corners) if mirrored else corners))


def corners_of(folder):
    """Per annotated vehicle its corners, or None."""
    return [
        row.get("corners_px")
        for file in sorted(folder.glob("*/annotations.json"))
        for row in json.loads(file.read_text())["annotations"]
        if not row["iscrowd"]
    ]


@pytest.mark.parametrize("first", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_corners_of_oriented_labels_stay_in_the_order_of_a_vehicle(tmp_path, first, mirrored):
    # Its middle in the second tile of the first row; its tail reaches into the first one.
    label = turned(70, 30, 30, 14, 25, first, mirrored)
    one_image(tmp_path, pixels(label))
    (corners,) = corners_of(tmp_path / "set")
    expected = [(x - 64, y) for x, y in turned(70, 30, 30, 14, 25).corners]
    # Nose and tail are not told apart; left and right are.
    either = [expected, expected[2:] + expected[:2]]
    assert any(np.allclose(corners, one, atol=1e-6) for one in either)
    assert boxes(tmp_path / "set", 1).keys() == {"a-00000-00000"}, "beside, it is ignored"


def test_upright_labels_have_no_corners_whatever_the_image(tmp_path):
    one_image(tmp_path, pixels(box(10, 10, 40, 24), turned(100, 30, 30, 14, 90)))
    assert corners_of(tmp_path / "set") == [None, None]
    # In a turned image an upright box says no more of the vehicle than before.
    affine = Affine.translation(EAST, NORTH) * Affine.rotation(25) * Affine.scale(0.125, -0.125)
    write_image(tmp_path / "b.tif", noise(400, 400), crs=NZTM, transform=affine)
    labels = pixels(box(180, 180, 210, 194), turned(220, 220, 30, 14, 10), stem="b")
    tile([tmp_path / "b.tif"], tmp_path / "turned", labels=(labels, LabelSettings(WHERE, ("car",))))
    upright, oriented = sorted(corners_of(tmp_path / "turned"), key=bool)
    assert upright is None
    front, rear = np.mean(oriented[:2], 0), np.mean(oriented[2:], 0)
    # 10 degrees in the image, which lies turned by 25.
    assert np.hypot(*(front - rear)) == pytest.approx(30, abs=0.05)
    heading_deg = math.degrees(math.atan2(rear[1] - front[1], front[0] - rear[0])) % 180
    assert heading_deg == pytest.approx(35, abs=0.1)


def test_outlines_on_the_ground_are_oriented_too(tmp_path):
    write_image(tmp_path / "a.tif", noise(256, 256), **PLACE)
    outline = [(EAST + x / 8, NORTH - y / 8) for x, y in turned(40, 40, 36, 15, 120).corners]
    labels = GroundLabels(("vehicle",), (Label("vehicle", tuple(outline)),), NZTM)
    tile([tmp_path / "a.tif"], tmp_path / "set", labels=(labels, LabelSettings(WHERE)))
    (corners,) = corners_of(tmp_path / "set")
    expected = list(turned(40, 40, 36, 15, 120).corners)
    either = [expected, expected[2:] + expected[:2]]
    assert any(np.allclose(corners, one, atol=1e-4) for one in either)
