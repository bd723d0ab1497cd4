"""From sheets like a LINZ Data Service export and GeoJSON labels to a dataset with one command."""

import json

import numpy as np
import pytest
from rasterio.transform import from_origin
from rasterio.warp import transform as transform_places

from skyproof.datasets.dataset import Dataset
from skyproof.main import run
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS
from tests.imagery.made import all_tiles, smooth_noise, write_image

EAST, NORTH = 1_554_000.0, 5_176_800.0
CARS = [(20.3, -11.7), (60.2, -30.1), (100.9, -77.7), (150.4, -20.6), (64.1, -100.2)]


@pytest.fixture
def export(tmp_path):
    """Four sheets of 640 x 480 px, named after a layout; cars are bright squares on dull ground."""
    scene = smooth_noise(960, 1280) // 2
    for x, y in CARS:
        column, row = round(x * 8), round(-y * 8)
        scene[:, row - 16 : row + 16, column - 16 : column + 16] = 255
    folder = tmp_path / "lds-selwyn-0125m-urban"
    folder.mkdir()
    for number in range(4):
        row, column = divmod(number, 2)
        # The last sheet begins 40 px early: sheets may overlap.
        top, left = row * 480, column * 640 - (40 if number == 3 else 0)
        write_image(
            folder / f"BX23_500_0{31 + row}0{44 + column}.tif",
            scene[:, top : top + 480, left : column * 640 + 640],
            crs="EPSG:2193",
            transform=from_origin(EAST + left / 8, NORTH - top / 8, 0.125, 0.125),
            photometric="RGB",
            tiled=True,
            blockxsize=256,
            blockysize=256,
        )
    (folder / "BX23_500_031044.tfw").write_text("0.125\n0\n0\n-0.125\n1554000.0625\n5176799.9375\n")
    return folder


@pytest.mark.parametrize("system", [4326, 2193])
@pytest.mark.parametrize("shape", ["points", "boxes"])
def test_an_export_becomes_a_dataset(tmp_path, export, capsys, system, shape):
    features = []
    for number, (x, y) in enumerate(CARS):
        ring = [
            (EAST + x + dx, NORTH + y + dy)
            for dx, dy in ((-2, -2), (2, -2), (2, 2), (-2, 2), (-2, -2))
        ]
        if shape == "points":
            ring = [(EAST + x, NORTH + y)]
        if system == 4326:
            ring = [
                *zip(
                    *transform_places(
                        "EPSG:2193", "EPSG:4326", *map(list, zip(*ring, strict=True))
                    ),
                    strict=True,
                )
            ]
        geometry = (
            {"type": "Point", "coordinates": ring[0]}
            if shape == "points"
            else {"type": "Polygon", "coordinates": [ring]}
        )
        kind = "Large Vehicle" if number == 4 else "Small Vehicle"
        features.append({"type": "Feature", "properties": {"class": kind}, "geometry": geometry})
    document = {"type": "FeatureCollection", "features": features}
    if system == 2193:
        document["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::2193"}}
    (tmp_path / "cars.geojson").write_text(json.dumps(document))
    out = tmp_path / "tiles"
    words = [
        "ground", export, "--tiling.size-px", 128, "--out", out,
        "--labels.path", tmp_path / "cars.geojson", "--labels.classes", "Small Vehicle",
        "--source.licence", "CC BY 4.0, LINZ Data Service",
    ]  # fmt: skip
    assert run([str(word) for word in words]) == 0, capsys.readouterr().err
    backgrounds = BackgroundSet.open(out)
    # 160 x 120 m are ten by seven and a half tiles of 16 m; sheet seams at 80 m and 60 m cut some.
    assert len(all_tiles(backgrounds)) == 10 * 7
    assert all(one.licence.startswith("CC BY 4.0") for one in all_tiles(backgrounds))
    assert all(backgrounds.tiles(split) for split in SPLITS)
    assert any(" + " in one.source for one in all_tiles(backgrounds))
    found = 0
    for split in SPLITS:
        dataset = Dataset.open(out / split)
        assert len(dataset) == len(backgrounds.tiles(split))
        for index, boxes in enumerate(dataset.boxes):
            image = dataset.image(index)
            for left, top, right, bottom in boxes.round().int().tolist():
                found += 1
                # The box holds the bright square that stands for the car, and nothing else.
                assert np.mean(image[0, top:bottom, left:right].numpy() > 200) > 0.85
        # The lorry's place is ignored, not background.
    assert found == 4
    ignored = [
        box for split in SPLITS for boxes in Dataset.open(out / split).ignore for box in boxes
    ]
    assert len(ignored) >= 1


def test_the_command_refuses_in_one_sentence(tmp_path, export, capsys):
    for words, message in (
        (["--tiling.size-px", "0"], "--tiling.size-px expects a whole number from 1"),
        (["--labels.path", str(tmp_path / "none.geojson")], "none.geojson is missing"),
        (["--source.crs", "moon"], "--source.crs expects"),
    ):
        assert run(["ground", str(export), "--out", str(tmp_path / "out"), *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert [*tmp_path.iterdir()] == [export]
    (tmp_path / "out").mkdir()
    assert run(["ground", str(export), "--out", str(tmp_path / "out")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_sheet_that_is_cut_off_leaves_nothing(tmp_path, export, capsys):
    sheet = export / "BX23_500_032044.tif"
    sheet.write_bytes(sheet.read_bytes()[: sheet.stat().st_size // 2])
    assert (
        run(["ground", str(export), "--tiling.size-px", "128", "--out", str(tmp_path / "out")]) == 2
    )
    error = capsys.readouterr().err
    assert sheet.name in error
    assert error.count("\n") == 1
    assert [*tmp_path.iterdir()] == [export]
