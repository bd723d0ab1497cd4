"""`assess` looks at imagery, labels and checkpoint before it makes anything."""

import json
import re
import shutil
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from rasterio.transform import from_origin

from skyproof.assessment.run import Run
from skyproof.detectors.card import reference_folder
from skyproof.errors import SkyproofError
from skyproof.imagery.tiles import sources, tiling
from skyproof.results.statistics.acceptance import fewest_tiles
from tests.cli.conftest import Skyproof
from tests.imagery.made import features, noise, shape, smooth_noise, write_image, written

MOBILE = "fasterrcnn_mobilenet_v3_large_320_fpn"
CAR_PX = (36, 15)
"""4.5 x 1.9 m at 12.5 cm per pixel."""

_REJECT = next(each / 100 for each in range(99, 0, -1) if fewest_tiles(each / 100, 0.05) == 5)
FIVE_TILES = ["--accept", 0.01, "--reject", _REJECT]
"""A requirement that takes five test tiles at least."""


@pytest.fixture
def photographs(tmp_path):
    """Four photographs of 75 x 75 m at 12.5 cm per pixel with ten cars and a bus each."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "town.names").write_text("car\nbus\n")
    for number in range(4):
        ground = np.random.default_rng(number).permuted(noise(600, 600), axis=1)
        Image.fromarray(ground.transpose(1, 2, 0)).save(folder / f"{number}.png")
        lines = [
            f"0 {0.05 + 0.09 * place} 0.3 {CAR_PX[place % 2] / 600} {CAR_PX[1 - place % 2] / 600}"
            for place in range(10)
        ]
        (folder / f"{number}.txt").write_text("\n".join([*lines, "1 0.5 0.6 0.16 0.04"]))
    return folder


@pytest.fixture
def call(photographs, tmp_path):
    labels = ["--labels", photographs, "--label-classes", "car"]
    return ["assess", "retinanet", "--imagery", photographs, *labels, "--out", tmp_path / "run"]


def test_a_plan_says_what_the_imagery_holds(call, tmp_path, skyproof: Skyproof):
    answer = skyproof(*call, "--gsd", 0.125, "--plan")
    assert answer.code == 0, answer.err
    first, places, second, third, *_ = answer.out.splitlines()
    assert places == "4 images without georeference show at most 4 distinct places"
    assert first.startswith("4 images of 75 x 75 m at 12.5 cm per pixel, 0 of them on a map: about")
    assert second == "40 labelled vehicles, the median is 4.5 m long (a car is about 4.5 m)"
    assert re.fullmatch(r"about \d+ labelled vehicles on tiles.*", third)
    assert not (tmp_path / "run").exists()


def test_ground_that_several_photographs_show_counts_once(
    photographs, tmp_path, skyproof: Skyproof
):
    """Copies are no more ground for a test than one photograph."""
    call = ["assess", "retinanet", "--gsd", 0.125, "--plan", "--out", tmp_path / "run"]
    tiles = []
    for copies in (1, 4):
        folder = tmp_path / f"{copies} copies"
        folder.mkdir()
        for number in range(copies):
            shutil.copy(photographs / "0.png", folder / f"{number}.png")
        answer = skyproof(*call, "--imagery", folder)
        assert answer.code == 0, answer.err
        tiles.append(re.search(r"about (\d+) tiles? of .+ m, which cover (\d+)\s%", answer.out)[0])
    assert tiles[0] == tiles[1]
    assert "4 images without georeference show at most 1 distinct place\n" in answer.out


@pytest.mark.parametrize(("gsd_m", "length_m"), [(0.25, "9.0"), (0.06, "2.2")])
def test_a_wrong_resolution_is_seen_by_the_length_of_cars(
    call, tmp_path, skyproof: Skyproof, gsd_m, length_m
):
    skyproof(*call, "--gsd", gsd_m).refused(f"is {length_m} m long", "correct --gsd", "--go-on")
    assert not (tmp_path / "run").exists()
    assert skyproof(*call, "--gsd", gsd_m, "--go-on", "--plan").code == 0


def test_a_wrong_resolution_is_told_beside_too_few_tiles(call, skyproof: Skyproof):
    skyproof(*call, "--gsd", 0.012, "--plan").refused("is 0.4 m long", "no image holds")


def test_images_and_labels_in_folders_of_splits_are_found_and_told(
    call, photographs, tmp_path, skyproof: Skyproof
):
    data = tmp_path / "data"
    for file in photographs.iterdir():
        split = "train" if file.stem in "01" else "val"
        kind = {".png": f"images/{split}", ".txt": f"labels/{split}"}.get(file.suffix, ".")
        (data / kind).mkdir(parents=True, exist_ok=True)
        shutil.copy(file, data / kind / file.name)
    for images, labels in ((data / "images", data / "labels"), (data, data)):
        words = [labels if word == photographs else word for word in call]
        words[3] = images
        answer = skyproof(*words, "--gsd", 0.125, "--plan")
        assert answer.code == 0, answer.err
        assert "40 labelled vehicles, the median is 4.5 m long" in answer.out
        for split in ("train", "val"):
            assert f": found in the folder {data / 'images' / split}" in answer.out
    shutil.copy(data / "images/train/0.png", data / "images/val/0.png")
    skyproof(*words, "--gsd", 0.125, "--plan").refused(
        "shares its name with another image", str(data / "images/train/0.png")
    )


def test_corners_in_place_of_sizes_are_seen_though_the_file_states_no_size_of_images(
    call, photographs, tmp_path, skyproof: Skyproof
):
    def coco(box):
        rows = [
            {"id": 10 * image + place, "image_id": image, "category_id": 1, "bbox": box(place)}
            for image in range(4)
            for place in range(10)
        ]
        images = [{"id": number, "file_name": f"{number}.png"} for number in range(4)]
        categories = [{"id": 1, "name": "car"}]
        document = {"categories": categories, "images": images, "annotations": rows}
        return written(tmp_path / "labels.json", json.dumps(document))

    wide, high = CAR_PX

    def corners(place):
        left, top = 40 + 50 * place, 320
        return [left, top, left + wide, top + high]

    words = [coco(corners) if word == photographs else word for word in call]
    words[3] = photographs
    skyproof(*words, "--gsd", 0.125).refused(
        "40 of 40 boxes of", "as if they were left, top, right, bottom; write left, top, width"
    )
    assert not (tmp_path / "run").exists()
    coco(lambda place: [*corners(place)[:2], wide, high])
    assert skyproof(*words, "--gsd", 0.125, "--plan").code == 0


def test_labels_that_lie_on_no_tile_are_refused_at_once(
    call, photographs, tmp_path, skyproof: Skyproof
):
    for path in photographs.glob("*.txt"):
        path.write_text("0 0.97 0.97 0.06 0.025")
    skyproof(*call, "--gsd", 0.125).refused("No labelled vehicle lies on a tile", "--labels")
    point = {"type": "Point", "coordinates": [11.5, 48.1]}
    feature = {"type": "Feature", "properties": {"class": "car"}, "geometry": point}
    file = tmp_path / "elsewhere.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    words = [file if word == photographs else word for word in call]
    words[3] = photographs
    skyproof(*words, "--gsd", 0.125).refused("in map coordinates but no image says where it lies")
    assert not (tmp_path / "run").exists()


def test_too_few_tiles_for_the_requirement_are_seen_at_once(
    photographs, tmp_path, skyproof: Skyproof
):
    call = ["assess", "retinanet", "--imagery", photographs / "0.png", "--gsd", 0.125]
    out = ["--out", tmp_path / "run"]
    skyproof(*call, *FIVE_TILES, *out).refused(
        "holds at most", "on fewer than 5 no detector can be accepted"
    )
    assert not (tmp_path / "run").exists()


@pytest.fixture
def checkpoint(tmp_path):
    """Options for a torchvision checkpoint with the classes 1 and 2."""
    from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_320_fpn

    network = fasterrcnn_mobilenet_v3_large_320_fpn(
        weights=None, weights_backbone=None, num_classes=3
    )
    torch.save(network.state_dict(), tmp_path / "best.pt")
    return [tmp_path / "best.pt", "--architecture", MOBILE]


def test_a_class_that_the_checkpoint_lacks_is_seen_at_once(
    call, checkpoint, tmp_path, skyproof: Skyproof
):
    words = [*checkpoint, *call[2:], "--gsd", 0.125, "--vehicle-classes", 3]
    skyproof("assess", *words).refused("label numbers from 1 to 2", "got 3")
    assert not (tmp_path / "run").exists()


def test_all_mistakes_are_told_at_once(call, checkpoint, tmp_path, skyproof: Skyproof):
    words = [*checkpoint, *call[2:], "--gsd", 0.06, "--vehicle-classes", 3, *FIVE_TILES]
    skyproof("assess", *words).refused("got 3", "is 2.2 m long", "no detector can be accepted")
    assert not (tmp_path / "run").exists()


def test_errors_name_the_options_of_assess(call, photographs, tmp_path, skyproof: Skyproof):
    skyproof(*call).refused("give its metres per pixel (--gsd)")
    without = [word for word in call if word not in ("--label-classes", "car")]
    skyproof(*without, "--gsd", 0.125).refused(
        "names the classes car, bus; say with --label-classes"
    )
    assert not (tmp_path / "run").exists()


def test_the_field_of_classes_is_asked_for_and_named(tmp_path, skyproof: Skyproof):
    east, north = 500_000.0, 5_000_000.0
    place = {"crs": "EPSG:32631", "transform": from_origin(east, north, 0.125, 0.125)}
    write_image(tmp_path / "town.tif", smooth_noise(960, 960), **place)
    points = [
        shape("Point", [east + 10 + 20 * number, north - 10 - 20 * number]) for number in range(4)
    ]
    document = features(
        *points,
        properties=[{"kind": kind, "by": "me"} for kind in ("car", "tree", "car", "van")],
        crs={"type": "name", "properties": {"name": "EPSG:32631"}},
    )
    path = written(tmp_path / "town.geojson", document)
    ground = ["ground", tmp_path / "town.tif", "--labels.path", path]
    small = ["--tiling.size-px", 96, "--out", tmp_path / "tiles"]
    skyproof(*ground, *small).refused("kind (car, tree, van)", "--labels.classes kind=car")
    assess = ["assess", "retinanet", "--imagery", tmp_path / "town.tif", "--labels", path]
    skyproof(*assess, "--plan", "--out", tmp_path / "run").refused("--label-classes kind=car")
    words = [*assess, "--label-classes", "car", "van", "--plan", "--out", tmp_path / "run"]
    assert "from its field 'kind'" in skyproof(*words).out
    assert skyproof(*ground, "--labels.classes", "kind=car", "kind=van", *small).code == 0
    counts = json.loads((tmp_path / "tiles/tiling.json").read_text())["counts"].values()
    assert sum(count["vehicles"] for count in counts) == 3
    assert sum(count["ignored"] for count in counts) >= 1


def test_headers_of_images_are_read_once(call, monkeypatch, skyproof: Skyproof):
    read = []
    inspect = sources.inspect_source

    def counted(path, *args):
        read.append(path.name)
        return inspect(path, *args)

    def stop(*args, **kwargs):
        raise SkyproofError("tiled")

    monkeypatch.setattr(sources, "inspect_source", counted)
    monkeypatch.setattr(tiling, "assign_splits", stop)
    skyproof(*call, "--gsd", 0.125).refused("tiled")
    assert sorted(read) == ["0.png", "1.png", "2.png", "3.png"]


def test_notes_of_the_first_look_are_told_once_and_kept_in_a_file(
    call, photographs, tmp_path, monkeypatch, skyproof: Skyproof
):
    def tiles_alone(run):
        run.steps[0].work()
        raise SkyproofError("tiled")

    (photographs / "3.txt").unlink()
    monkeypatch.setattr(Run, "do", tiles_alone)
    answer = skyproof(*call, "--gsd", 0.125)
    assert "tiled" in answer.err
    told = answer.out.splitlines()
    notes = json.loads((tmp_path / "run/tiles/tiling.json").read_text())["notes"]
    twice = [each for each in set(told) if "note:" in each and told.count(each) > 1]
    assert twice == []
    assert "3.png: no labels, so nothing is scored on its tiles" in notes
    for words in ("at most 4 distinct places", "3.png: no labels", "blur measured"):
        assert [words in line for line in told].count(True) == 1, told
        assert any(words in note for note in notes)


def _detector(place, change):
    """A copy of a reference detector with another byte in a file."""
    shutil.copytree(reference_folder("retinanet"), place)
    file = place / change
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    return place


def _no_blender(place):
    place.write_text("#!/bin/sh\necho I am no Blender\n")
    place.chmod(0o755)
    return place


def _below_a_file(place):
    place.write_text("precious")
    return place / "run"


MISTAKES = {
    "class": (["best.pt", "--architecture", MOBILE, "--vehicle-classes", 9], "label numbers from"),
    "architecture": (
        ["best.pt", "--architecture", "fcos_resnet50_fpn", "--vehicle-classes", 1],
        "give the --architecture they were trained as",
    ),
    "unknown architecture": (
        ["best.pt", "--architecture", "fasterrcnn", "--vehicle-classes", 1],
        "fasterrcnn_mobilenet_v3_large_320_fpn",
    ),
    "labels": (["retinanet", "--labels", "none.json"], "none.json is not there"),
    "label class": (["retinanet", "--label-classes", "ship"], "no class 'ship'"),
    "blender": (["retinanet", "--cycles", "--blender", _no_blender], "is neither Blender nor"),
    "weights": ([partial(_detector, change="weights.safetensors")], "is not the file that"),
    "card": ([partial(_detector, change="detector.json")], "detector.json"),
    "out": (["retinanet", "--out", _below_a_file], "choose another --out"),
    "device": (["retinanet", "--device", "cuda:9"], "--device cuda:9 is not usable here"),
}


@pytest.mark.parametrize("plan", [(), ("--plan",)], ids=["run", "plan"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_of_options_show_before_the_imagery_is_cut(
    mistake, plan, call, checkpoint, tmp_path, monkeypatch, skyproof: Skyproof
):
    def never(*args, **kwargs):
        raise AssertionError("tiled")

    monkeypatch.setattr("skyproof.cli.ground.Ground.run", never)
    monkeypatch.chdir(tmp_path)
    words, sentence = MISTAKES[mistake]
    made = [word(tmp_path / "made") if callable(word) else word for word in words]
    given = ["--gsd", 0.125, *call[2:], *plan]
    # An option that is given twice has the last value.
    skyproof("assess", made[0], *given, *made[1:]).refused(sentence)
    assert not (tmp_path / "run").exists()


def test_the_first_look_says_what_a_run_will_not(call, photographs, tmp_path, skyproof: Skyproof):
    told = skyproof(*call, "--gsd", 0.125, "--plan").out
    assert "without --accept and --reject, there is no verdict" in told
    assert "AP on real vehicles" not in told
    assert "steps will take about" in told.splitlines()[-1]
    bare = ["assess", "retinanet", "--imagery", photographs, "--gsd", 0.125]
    told = skyproof(*bare, "--out", tmp_path / "run", "--plan").out
    assert "without --labels" in told
    assert "AP on real vehicles is unknown" in told
    coarse = tmp_path / "coarse"
    shutil.copytree(reference_folder("retinanet"), coarse)
    card = json.loads((coarse / "detector.json").read_text())
    (coarse / "detector.json").write_text(json.dumps(card | {"gsd_m": 0.25}))
    told = skyproof("assess", coarse, "--out", tmp_path / "run", "--plan").out
    assert "the detector sees 0.25 m per pixel" in told
    assert "query attacks are left out" in told
    assert "says nothing about your sites" in told


def test_too_few_images_for_the_splits_are_seen_at_once(tmp_path, skyproof: Skyproof):
    for number in range(2):
        ground = np.random.default_rng(number).permuted(noise(160, 160), axis=1)
        Image.fromarray(ground.transpose(1, 2, 0)).save(tmp_path / f"{number}.png")
    words = ["assess", "retinanet", "--imagery", tmp_path, "--gsd", 0.125, "--out"]
    for plan in ((), ("--plan",)):
        skyproof(*words, tmp_path / "run", *plan).refused("yields 2 tiles of at least 16.0 m")
    assert not (tmp_path / "run").exists()
