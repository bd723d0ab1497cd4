"""The tiny world: a run, tiled imagery, labels of every form, a palette, a preset."""

from __future__ import annotations

import json
import shutil
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import rasterio
from PIL import Image
from rasterio.transform import from_origin

from skyproof.detectors.card import read_card
from skyproof.generator.fits import draw_prototypes, fitted_vehicles
from skyproof.generator.folder import save_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.main import run
from skyproof.reproduction.preset import PRESETS
from skyproof.results.precheck import (
    PRECHECK_FILE,
    MeasuredOn,
    PrecheckRecord,
    Rate,
    write_precheck,
)
from skyproof.results.rows_file import write_rows
from skyproof.results.score_folder import Baseline
from skyproof.results.statistics.intervals import Interval
from tests.generator.made_fits import made_fits
from tests.imagery.made import smooth_noise
from tests.results.test_likeness import likeness
from tests.tiny_suite import TINY_SUITE, draw_datasets, tiny_suite

__all__ = ["ASSESS", "make_world", "one_texture"]

ASSESS = ("assess", "retinanet", "--device", "cpu")
_SUITE = replace(
    TINY_SUITE,
    # T-PixFcMa would be in no document of another form.
    attacks=("T-U",),
    settings=replace(TINY_SUITE.settings, batch_size=1),
    steps=replace(TINY_SUITE.steps, texture=2),
    draws=1,
    attack_m=12.0,
    image_m=12.0,
    test_images=2,
    empty_images=2,
    tiles=(1, 1, 1, 1),
    vehicles=(1, 1, 1, 1),
)

_SIDE_PX = 160
_EAST, _NORTH = 1_550_000.0, 5_190_000.0
_BOXES = [(20, 20, 30, 14), (90, 100, 30, 14)]

YOLO_TEXT = "0 0.3 0.3 0.1 0.1\n1 0.15 0.15 0.25 0.15 0.25 0.25 0.15 0.25\n"
CLASSES = "train: images\nnames:\n  0: car\n  1: bus\nnc: 2\n"
DOTA_TEXT = (
    "imagesource:GoogleEarth\ngsd:0.125\n"
    "20 20 50 20 50 34 20 34 car 0\n90 100 120 100 120 114 90 114 bus 1\n"
)
VISDRONE_TEXT = "20, 20, 30, 14, 1, 4, 0, 0\n90,100,30,14,0,5,1,2,\n"
VOC_TEXT = (
    "<annotation><filename>photo.tif</filename><object><name>car</name><difficult> 0 </difficult>\n"
    "<bndbox><xmin> 21 </xmin><ymin> 21 </ymin><xmax>50</xmax><ymax>34</ymax></bndbox></object>\n"
    "</annotation>\n"
)


def one_texture() -> AbstractContextManager[None]:
    """Within it runs have T-U alone."""
    return tiny_suite(_SUITE)


def make_world(folder: Path) -> None:
    """Writes everything below a folder that is not there yet."""
    with one_texture():
        assert run([*ASSESS, "--out", str(folder)]) == 0
    draw_datasets(folder, 96, train=6, validation=2)
    _write_check(folder / "detectors/retinanet")
    write_rows(folder / "scores/test-0/likeness.json", [likeness()])
    imagery = folder / "imagery"
    imagery.mkdir()
    _write_photo(imagery / "photo.tif")
    _write_labels(folder / "labels", imagery / "photo.tif")
    tiled = ["ground", imagery, "--out", folder / "tiled", "--tiling.size-px", 40]
    tiled += ["--labels.path", folder / "labels" / "coco.json", "--labels.classes", "car"]
    assert run(list(map(str, tiled))) == 0
    clear = ["clear", folder / "tiled", "--out", folder / "cleared", "--device", "cpu"]
    assert run(list(map(str, clear))) == 0
    palette = {"colours_srgb": [[90, 100, 80], [120, 110, 90], [60, 70, 50]]}
    (folder / "palette.json").write_text(json.dumps(palette))
    shutil.copy(PRESETS["quick"], folder / "preset.json")
    bodies = draw_prototypes(["saloon", "van"], 1, 0)
    learnt = LayeredGenerator.learn(fitted_vehicles(made_fits(bodies, 4), bodies))
    save_generator(folder / "learnt", learnt, {"vehicles": 4})


def _write_check(folder: Path) -> None:
    card = read_card(folder)
    some = Interval(0.5, 0.25, 0.75)
    check = Baseline("retinanet", "renders", 2, 2, False, some, "places", 2, 0.5, some, some, 0.5)
    rates = [Rate("paint_body", "#ff8000", 1, some, (1, 0)), Rate("blur", "0.4 px", 1, some)]
    on = MeasuredOn(2, "", ("procedural",), 1, 0)
    # The one that it came with tells of more.
    (folder / PRECHECK_FILE).unlink()
    known = ("retinanet", card.weights_sha256, card.threshold, on)
    record = PrecheckRecord(*known, [check], rates, (2, 1), [likeness()])
    write_precheck(folder, record)


def _write_photo(path: Path) -> None:
    place = {"crs": "EPSG:2193", "transform": from_origin(_EAST, _NORTH, 0.125, 0.125)}
    profile = {"driver": "GTiff", "count": 3, "dtype": "uint8", **place}
    with rasterio.open(path, "w", width=_SIDE_PX, height=_SIDE_PX, **profile) as file:
        file.write(smooth_noise(_SIDE_PX, _SIDE_PX))


def _write_labels(folder: Path, photo: Path) -> None:
    folder.mkdir()
    coco = {
        "categories": [{"id": 1, "name": "car"}, {"id": 7, "name": "bus"}],
        "images": [{"id": 3, "file_name": "photo.tif", "width": _SIDE_PX, "height": _SIDE_PX}],
        "annotations": [
            {"id": number, "image_id": 3, "category_id": 1, "bbox": list(box), "iscrowd": 0}
            for number, box in enumerate(_BOXES)
        ],
    }
    (folder / "coco.json").write_text(json.dumps(coco))
    points = [(_EAST + 0.125 * x, _NORTH - 0.125 * y) for x, y, _, _ in _BOXES]
    geojson = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "EPSG:2193"}},
        "features": [
            {
                "type": "Feature",
                "properties": {"class": "car"},
                "geometry": {"type": "Point", "coordinates": list(point)},
            }
            for point in points
        ],
    }
    (folder / "points.geojson").write_text(json.dumps(geojson))
    (folder / "yolo").mkdir()
    (folder / "yolo" / "data.yaml").write_text(CLASSES)
    (folder / "yolo" / "photo.txt").write_text(YOLO_TEXT)
    with Image.open(photo) as picture:
        picture.save(folder / "yolo" / "photo.png")
    (folder / "dota").mkdir()
    (folder / "dota" / "photo.txt").write_text(DOTA_TEXT)
    (folder / "visdrone").mkdir()
    (folder / "visdrone" / "photo.txt").write_text(VISDRONE_TEXT)
    (folder / "voc").mkdir()
    (folder / "voc" / "photo.xml").write_text(VOC_TEXT)
