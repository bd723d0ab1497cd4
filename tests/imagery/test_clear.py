"""Clearing a tiled folder: who finds what, what is repaired or left out, what the record says."""

import json
import math
import re
import shutil
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from skyproof.datasets.coco import Annotation, CocoWriter
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Detections, TrainableDetector
from skyproof.errors import ConfigurationError, ImageryError, RunFolderError, StoredFileError
from skyproof.files import finished_folder
from skyproof.imagery.clearing.clear import clear_backgrounds, reject_tiles
from skyproof.imagery.clearing.sheet import SheetRow, write_figure, write_page
from skyproof.imagery.clearing.vehicle_masks import VehicleFinder, grown_to_what_is_seen
from skyproof.scenes.background_index import BackgroundTile, write_index
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS

SIZE_PX = 120
GROUND, RED = (100, 110, 120), (250, 0, 0)


def box(left, top):
    return (float(left), float(top), left + 30.0, top + 14.0)


VEHICLES = {
    "a": [box(20, 20), box(60, 80)],
    "b": [],
    "c": [box(40, 40)],
    "d": [box(10, 90)],
    "e": [box(70, 20)],
}
SPLIT_OF = {"a": "train", "b": "train", "c": "validation", "d": "attack", "e": "test"}


def tiled(folder, labelled=(), ignored=()):
    """Five tiles with red vehicles; labels for some of them."""
    tiles = []
    for split in SPLITS:
        with CocoWriter(folder / split, gsd_m=0.125) as writer:
            for name in (name for name, own in SPLIT_OF.items() if own == split):
                image = torch.tensor(GROUND, dtype=torch.uint8)[:, None, None].repeat(
                    1, SIZE_PX, SIZE_PX
                )
                for left, top, right, bottom in VEHICLES[name]:
                    image[:, int(top) : int(bottom), int(left) : int(right)] = torch.tensor(RED)[
                        :, None, None
                    ]
                rows = [
                    Annotation(b, ((b[0] + b[2]) / 2, (b[1] + b[3]) / 2), ignore=b in ignored)
                    for b in VEHICLES[name]
                    if name in labelled or b in ignored
                ]
                writer.add(image, name, rows)
                path = f"{split}/images/{name}.png"
                tiles.append(
                    BackgroundTile(
                        name, path, split, SIZE_PX, SIZE_PX, "photo.tif", (1, 2), licence="CC0"
                    )
                )
        if not labelled:
            (folder / split / "annotations.json").unlink()
    features = [
        {
            "type": "Feature",
            "geometry": None,
            "properties": {
                "id": name,
                "file": f"{split}/images/{name}.png",
                "split": split,
                "source": "photo.tif",
                "licence": "CC0",
                "crs": "EPSG:2193",
                "bounds": [0, 0, 1, 1],
            },
        }
        for name, split in SPLIT_OF.items()
    ]
    (folder / "index.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    write_index(folder, 0.125, tiles)
    return folder


class Reds:
    """Finds red vehicles by their colour: pixels above a strength, one box around each."""

    name = "reds"

    def __init__(self, blind_to=(), score_of=None):
        self.blind_to = blind_to
        self.score_of = score_of or {}

    def detect(self, images):
        found = []
        for image in images:
            boxes = []
            for own in {b for boxes in VEHICLES.values() for b in boxes if b not in self.blind_to}:
                part = image[:, int(own[1]) : int(own[3]), int(own[0]) : int(own[2])]
                if (part[0] - part[1]).mean() > 0.3:
                    boxes.append(own)
            scores = torch.tensor([self.score_of.get(own, 0.9) for own in boxes])
            found.append(Detections(torch.tensor(boxes).reshape(-1, 4), scores))
        return found


def finder(detector=None, gsd_m=0.125):
    card = DetectorCard("reds", threshold=0.5, gsd_m=gsd_m)
    return VehicleFinder(BlackBoxDetector(detector or Reds(), card=card), "reds")


def ground(image, mask):
    return torch.where(mask, torch.tensor(GROUND, dtype=torch.uint8)[:, None, None], image)


def cleared(folder, tmp_path, fill=ground, **options):
    with finished_folder(tmp_path / "cleared") as partial:
        record = clear_backgrounds(folder, partial, fill=fill, **options)
    return BackgroundSet.open(tmp_path / "cleared"), record


def reds(backgrounds, name):
    image = backgrounds.pixels(name).int()
    return int((image[0] - image[1] > 60).sum())


def test_labelled_vehicles_and_ignore_regions_are_removed(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde", ignored=[box(60, 80)])
    result, record = cleared(folder, tmp_path)
    assert all(reds(BackgroundSet.open(folder), name) for name in "acde")
    assert not any(reds(result, name) for name in SPLIT_OF)
    before = BackgroundSet.open(folder)
    for name in SPLIT_OF:
        # The light is measured anew, without the vehicles.
        same = replace(result.tile(name), removed=(), drivable=None, light=None)
        assert same == before.tile(name)
    assert result.gsd_m == 0.125
    totals = record["totals"]
    assert (totals["labelled_removed"], totals["detected_removed"], totals["kept"]) == (5, 0, 5)
    assert record["checked_by"] == "not checked by a detector"
    assert record["vehicles_from"] == ["labels"]
    assert json.loads((tmp_path / "cleared" / "clearing.json").read_text()) == record
    assert len(json.loads((tmp_path / "cleared" / "index.geojson").read_text())["features"]) == 5


def stood(result, name):
    """What is known of a tile's removed vehicles, headings to 5 degrees."""
    known = []
    for one in result.tile(name).removed:
        heading_deg = None
        if one.heading_rad is not None:
            heading_deg = 5 * round(math.degrees(one.heading_rad) / 5) % 180
        known.append((round(one.x_px), round(one.y_px), heading_deg, one.heading_from))
    return known


def test_it_is_kept_where_and_how_the_vehicles_stood(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde", ignored=[box(60, 80)])
    # An oriented label, of a vehicle 4 m long and 2 m wide that heads 30 degrees to the left of up.
    turn = math.radians(120)
    along = np.array([math.cos(turn), -math.sin(turn)])
    left = np.array([along[1], -along[0]])
    corners = [
        (np.array([55.0, 47.0]) + along * u + left * v).tolist()
        for u, v in ((16, 8), (16, -8), (-16, -8), (-16, 8))
    ]
    change_rows(folder / "validation", corners_px=corners)
    # A vehicle that the tile's border cuts.
    change_rows(folder / "attack", visible_fraction=0.6, centre_px=[8.0, 97.0])
    result, record = cleared(folder, tmp_path)
    # The ignore region at (60, 80) of tile a is no vehicle; the red boxes lie level.
    assert stood(result, "a") == [(35, 27, 0, "picture")]
    assert stood(result, "b") == []
    assert stood(result, "c") == [(55, 47, 120, "label")]
    assert stood(result, "d") == [(8, 97, None, None)]
    assert stood(result, "e") == [(85, 27, 0, "picture")]
    (oriented,) = result.tile("c").removed
    assert (oriented.length_m, oriented.width_m) == (4.0, 2.0)
    (pictured,) = result.tile("a").removed
    assert pictured.length_m == pytest.approx(30 * 0.125, abs=0.15)
    assert pictured.width_m == pytest.approx(14 * 0.125, abs=0.1)
    assert record["totals"]["places"] == 4
    # It goes with the tiles when some are rejected.
    reject_tiles(tmp_path / "cleared", ["a"])
    assert BackgroundSet.open(tmp_path / "cleared").tile("c").removed == (oriented,)


def change_rows(folder, **values):
    """Changes all annotations of a split."""
    path = folder / "annotations.json"
    document = json.loads(path.read_text())
    for row in document["annotations"]:
        row.update(values)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("corners", [[[5, 5]] * 4, [[5, 5], [9, 9]], [[0, 0], [1e9, 0]] * 2])
def test_corners_that_are_no_vehicles_say_nothing(tmp_path, corners):
    folder = tiled(tmp_path / "tiled", labelled="c")
    change_rows(folder / "validation", corners_px=corners)
    result, _ = cleared(folder, tmp_path)
    assert stood(result, "c") == [(55, 47, 0, "picture")]


def test_detections_make_no_places(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="a")
    result, record = cleared(folder, tmp_path, finder=finder())
    assert record["totals"]["detected_removed"] > 1
    assert [len(stood(result, name)) for name in "abcde"] == [2, 0, 0, 0, 0]
    # Clearing what is cleared keeps the places.
    again = clear_again(tmp_path)
    assert again.tile("a").removed == result.tile("a").removed


def clear_again(tmp_path):
    with finished_folder(tmp_path / "again") as partial:
        clear_backgrounds(tmp_path / "cleared", partial, finder=finder())
    return BackgroundSet.open(tmp_path / "again")


def test_cleared_ground_is_drivable_where_vehicles_stood(tmp_path):
    result, _ = cleared(tiled(tmp_path / "tiled", labelled="acde"), tmp_path)
    assert result.tile("b").drivable is None
    assert result.tile("c").drivable == "drivable/c.png"
    drivable = result.directions("c") > 0
    assert drivable[40:54, 40:70].all(), "the plain ground that was filled in"


def test_where_nobody_labelled_and_nothing_is_found_grey_ground_is_drivable(tmp_path):
    result, _ = cleared(tiled(tmp_path / "tiled"), tmp_path, finder=finder())
    assert result.tile("b").drivable == "drivable/b.png"
    assert (result.directions("b") > 0).float().mean() > 0.5


def test_bytes_beside_the_vehicles_stay(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="c")
    result, _ = cleared(folder, tmp_path, fill=lambda image, mask: image * ~mask)
    changed = (result.pixels("c") != BackgroundSet.open(folder).pixels("c")).any(0)
    # One label of this source: the shadow is unknown, so that the margin is twice 0.4 m.
    expected = torch.zeros_like(changed)
    expected[40 - 6 : 54 + 6, 40 - 6 : 70 + 6] = True
    assert torch.equal(changed, expected)


def test_the_detector_finds_what_is_not_labelled(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="a")
    result, record = cleared(folder, tmp_path, finder=finder())
    assert not any(reds(result, name) for name in SPLIT_OF)
    rows = {row["id"]: (row["labelled"], row["detected"]) for row in record["tiles"]}
    assert rows == {"a": (2, 0), "b": (0, 0), "c": (0, 1), "d": (0, 1), "e": (0, 1)}
    assert record["vehicles_from"] == ["labels", "reds"]


def test_labels_grow_to_what_the_detector_sees_of_the_same_vehicle():
    label = torch.tensor([[10.0, 10.0, 42.0, 42.0], [100.0, 10.0, 132.0, 42.0]])
    seen = torch.tensor(
        [[6.0, 14.0, 47.0, 38.0], [8.0, 12.0, 44.0, 40.0], [200.0, 0.0, 240.0, 9.0]]
    )
    grown = grown_to_what_is_seen(label, seen)
    # The second is likest: what is left of the label stays, bumpers on both sides are added.
    assert grown.tolist() == [[8.0, 10.0, 44.0, 42.0], [100.0, 10.0, 132.0, 42.0]]
    assert torch.equal(grown_to_what_is_seen(label, torch.zeros(0, 4)), label)


def test_no_bumper_of_a_point_label_is_left(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    # The label says 10 px less at either end than the vehicle is long.
    change_rows(folder / "validation", bbox=[50.0, 40.0, 10.0, 14.0])
    left, _ = cleared(folder, tmp_path / "labels")
    assert reds(left, "c")
    grown, record = cleared(folder, tmp_path / "seen", finder=finder())
    assert not reds(grown, "c")
    assert {row["id"]: (row["labelled"], row["detected"]) for row in record["tiles"]}["c"] == (1, 0)


def test_a_detection_below_the_detectors_threshold_is_left_alone(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="a")
    unsure = finder(Reds(score_of={box(40, 40): 0.4}))
    result, record = cleared(folder, tmp_path, finder=unsure)
    assert [name for name in SPLIT_OF if reds(result, name)] == ["c"]
    assert record["totals"]["detected_removed"] == 2


def test_what_nobody_labelled_is_left_to_the_detector_and_filled_without_one(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    change_rows(folder / "validation", iscrowd=1, unlabelled=True)
    _, alone = cleared(folder, tmp_path)
    assert {row["id"]: row["labelled"] for row in alone["tiles"]}["c"] == 1
    shutil.rmtree(tmp_path / "cleared")
    result, record = cleared(folder, tmp_path, finder=finder())
    row = {row["id"]: row for row in record["tiles"]}["c"]
    assert (row["labelled"], row["detected"]) == (0, 1)
    assert not reds(result, "c")


def test_without_labels_and_detector_nothing_can_be_found(tmp_path):
    with pytest.raises(ConfigurationError, match="no detector was given"):
        cleared(tiled(tmp_path / "tiled"), tmp_path, checker=finder())


def test_what_the_check_still_finds_is_repaired(tmp_path):
    folder = tiled(tmp_path / "tiled")
    blind = finder(Reds(blind_to=[box(40, 40)]))
    result, record = cleared(folder, tmp_path, finder=blind, checker=finder())
    rows = {row["id"]: row for row in record["tiles"]}
    assert not reds(result, "c")
    assert (rows["c"]["rounds"], rows["c"]["detected"], rows["c"]["remaining"]) == (1, 1, 0)
    assert (rows["a"]["rounds"], rows["a"]["remaining"]) == (0, 0)
    assert record["checked_by"] == {"name": "reds", "threshold": 0.5}


def test_what_cannot_be_repaired_is_left_out(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde")

    def not_in_d(image, mask):
        return image if mask[95, 20] else ground(image, mask)

    result, record = cleared(folder, tmp_path, fill=not_in_d, checker=finder())
    rows = {row["id"]: row for row in record["tiles"]}
    assert rows["d"]["left_out"] == "a vehicle is still found"
    assert (rows["d"]["rounds"], rows["d"]["remaining"]) == (2, 1)
    assert result.tiles("attack") == []
    assert not (tmp_path / "cleared" / "attack" / "images" / "d.png").exists()
    assert record["totals"]["splits_without_tiles"] == ["attack"]
    assert record["totals"]["left_out"] == {"a vehicle is still found": 1}
    places = json.loads((tmp_path / "cleared" / "index.geojson").read_text())["features"]
    assert {place["properties"]["id"] for place in places} == {"a", "b", "c", "e"}


def test_a_tile_with_too_much_to_remove_is_left_out(tmp_path, monkeypatch):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    monkeypatch.setattr("skyproof.imagery.clearing.clear.LARGEST_MASKED_SHARE", 0.08)
    result, record = cleared(folder, tmp_path)
    assert {row["id"]: row["left_out"] for row in record["tiles"]}["a"] == "too much to remove"
    assert [tile.id for tile in result.tiles("train")] == ["b"]


def test_nothing_left_is_one_sentence(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde")

    class Everywhere:
        name = "everywhere"

        def detect(self, images):
            return [
                Detections(torch.tensor([[5.0, 5, 15, 15]]), torch.tensor([0.9])) for _ in images
            ]

    with pytest.raises(ImageryError, match=r"No tile of .* \(5 a vehicle is still found\)"):
        cleared(folder, tmp_path, checker=finder(Everywhere()))
    assert not (tmp_path / "cleared").exists()


def test_a_detector_of_another_resolution_is_refused(tmp_path):
    with pytest.raises(
        ConfigurationError, match=r"trained at 0.25 m per pixel but the tiles have 0.125 m"
    ):
        cleared(tiled(tmp_path / "tiled"), tmp_path, finder=finder(gsd_m=0.25))


def test_damaged_labels_are_named(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="a")
    (folder / "train" / "annotations.json").write_text('{"images": [{}], "annotations": []}')
    with pytest.raises(
        StoredFileError, match=r"annotations\.json, images\[0\]: the field id is missing"
    ):
        cleared(folder, tmp_path)


def test_large_tiles_are_looked_at_in_windows():
    class Corner:
        """Finds a red spot wherever it is, and notes how large its pictures were."""

        name = "corner"
        sizes = ()

        def detect(self, images):
            self.sizes = (*self.sizes, tuple(images.shape))
            found = []
            for image in images:
                rows, columns = torch.nonzero(image[0] > 0.9, as_tuple=True)
                boxes = (
                    [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]
                    if len(rows)
                    else []
                )
                scores = torch.full((len(boxes),), 0.9)
                found.append(
                    Detections(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4), scores)
                )
            return found

    detector = Corner()
    image = torch.zeros(3, 500, 1900, dtype=torch.uint8)
    image[0, 300:310, 1100:1120] = 255
    assert finder(detector).detections(image).tolist() == [[1100, 300, 1120, 310]]
    assert detector.sizes == ((8, 3, 320, 384), (6, 3, 320, 384))


def test_the_sheet_shows_changed_tiles_before_and_after(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="acde")
    cleared(folder, tmp_path)
    sheets = tmp_path / "cleared" / "sheets"
    # The empty tile is not on it.
    names = ["00001.png", "00002.png", "00003.png", "00004.png", "index.html"]
    assert [path.name for path in sorted(sheets.iterdir())] == names
    with Image.open(sheets / "00001.png") as picture:
        assert picture.size == (2 * SIZE_PX + 8, SIZE_PX)
        assert picture.getpixel((30, 27)) == RED
        assert picture.getpixel((SIZE_PX + 8 + 30, 27)) == GROUND
    with Image.open(sheets / "00002.png") as picture:
        # The mask's outline: the box at (40, 40) of tile c, grown by 0.4 m.
        assert picture.getpixel((50, 40 - 3)) == (240, 228, 66)
        assert picture.getpixel((SIZE_PX + 8 + 50, 40 - 3)) == GROUND
    text = (sheets / "index.html").read_text()
    # The command that the page shows is one of the program's.
    assert text.count("skyproof clear") == text.count("--reject") == 2
    assert "http" not in text
    assert "not checked by a detector" in text
    assert re.findall('value="(.*?)"( disabled)?', text) == [(name, "") for name in "acde"]


def test_on_the_sheet_a_tile_that_was_left_out_cannot_be_rejected_and_names_are_escaped(tmp_path):
    pixels = torch.zeros(3, 8, 8, dtype=torch.uint8)
    mask = torch.zeros(8, 8, dtype=torch.bool)
    rows = [
        SheetRow(name, "what was done", kept, pixels, pixels, mask, torch.zeros(0, 4))
        for name, kept in (("<b>&'", True), ("out", False))
    ]
    figures = [write_figure(tmp_path / "sheets", number, row) for number, row in enumerate(rows)]
    write_page(tmp_path / "sheets", figures)
    text = (tmp_path / "sheets" / "index.html").read_text()
    assert 'value="&lt;b&gt;&amp;&#x27;">' in text
    assert 'value="out" disabled>' in text
    assert "<b><b>" not in text


def test_rejected_tiles_are_dropped(tmp_path):
    cleared(tiled(tmp_path / "tiled", labelled="acde"), tmp_path)
    folder = tmp_path / "cleared"
    assert reject_tiles(folder, ["a", "c"]) == ["validation"]
    assert [tile.id for split in SPLITS for tile in BackgroundSet.open(folder).tiles(split)] == [
        "b",
        "d",
        "e",
    ]
    assert json.loads((folder / "clearing.json").read_text())["rejected"] == ["a", "c"]
    assert len(json.loads((folder / "index.geojson").read_text())["features"]) == 3
    with pytest.raises(ConfigurationError, match="has no tile 'a'"):
        reject_tiles(folder, ["a"])
    (tmp_path / "elsewhere").mkdir()
    (folder / "linked").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunFolderError, match="linked is a link to a folder elsewhere"):
        reject_tiles(folder, ["b"])
    (folder / "linked").unlink()
    with pytest.raises(ConfigurationError, match="Every tile"):
        reject_tiles(folder, ["b", "d", "e"])


def test_dropped_tiles_leave_the_annotations_too(tmp_path):
    folder = tiled(tmp_path / "tiled", labelled="abcde")
    before = {
        split: json.loads((folder / split / "annotations.json").read_text()) for split in SPLITS
    }
    assert reject_tiles(folder, ["a", "e"]) == ["test"]
    assert [row["scene_id"] for row in before["train"]["images"]] == ["a", "b"]
    for split in SPLITS:
        kept = [row for row in before[split]["images"] if row["scene_id"] not in ("a", "e")]
        ids = {row["id"] for row in kept}
        rows = [row for row in before[split]["annotations"] if row["image_id"] in ids]
        after = json.loads((folder / split / "annotations.json").read_text())
        assert after == before[split] | {"images": kept, "annotations": rows}


class Network(Reds, TrainableDetector):
    def __init__(self):
        TrainableDetector.__init__(self)
        Reds.__init__(self)
        self.set_card(DetectorCard("reds", threshold=0.5, gsd_m=0.125))


def test_two_tiles_are_cleared_at_a_time_as_one_after_the_other(tmp_path, two_threads):
    folder = tiled(tmp_path / "tiled")
    _, expected = cleared(folder, tmp_path, finder=finder(), checker=finder())
    shutil.move(tmp_path / "cleared", tmp_path / "alone")
    both = threading.Barrier(2, timeout=20)

    def fill(image, mask):
        both.wait()
        return ground(image, mask)

    network = VehicleFinder(Network(), "reds")
    _, record = cleared(folder, tmp_path, fill=fill, finder=network, checker=network)
    assert record == expected
    files = [path for path in (tmp_path / "alone").rglob("*") if path.is_file()]
    assert len(files) > 5
    for path in files:
        other = tmp_path / "cleared" / path.relative_to(tmp_path / "alone")
        assert other.read_bytes() == path.read_bytes(), path
