"""Places of images: control points, RPCs, local systems, and resolutions that are doubted."""

import json

import pytest
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC
from rasterio.transform import from_origin

from skyproof.errors import ImageryError
from skyproof.imagery.tiles.sources import find_images
from tests.imagery.made import all_tiles, noise, tile, write_image

PLACE = from_origin(1_550_000, 5_190_000, 0.125, 0.125)
FOOT_M = 1200 / 3937
"""The foot of the survey of the United States, by its definition."""


def local(name, unit, length_m):
    return (
        f'ENGCRS["{name}",EDATUM["site"],CS[Cartesian,2],AXIS["x",east,ORDER[1]],'
        f'AXIS["y",north,ORDER[2]],LENGTHUNIT["{unit}",{length_m!r}]]'
    )


def with_control_points(path, array, offset_m=0.0, corners=((0, 0), (0, 1), (1, 0), (1, 1))):
    """An image of 200 x 200 px at PLACE, the last of whose control points is off."""
    points = []
    for number, (down, across) in enumerate(corners, 1):
        row, column = 200.0 * down, 200.0 * across
        x, y = PLACE * (column, row)
        off = offset_m if number == len(corners) else 0.0
        points.append(GroundControlPoint(row, column, x + off, y, 0.0))
    write_image(path, array)
    with rasterio.open(path, "r+") as dataset:
        dataset.gcps = points, rasterio.CRS.from_epsg(2193)
    return path


def with_rpcs(path):
    write_image(path, noise(200, 200))
    line = [0.0, 0.0, 1.0, *[0.0] * 17]
    sample = [0.0, 1.0, *[0.0] * 18]
    one = [1.0, *[0.0] * 19]
    rpcs = RPC(
        height_off=10.0, height_scale=100.0, lat_off=-43.4, lat_scale=0.001, long_off=172.4,
        long_scale=0.001, line_off=100.0, line_scale=100.0, samp_off=100.0, samp_scale=100.0,
        line_num_coeff=line, line_den_coeff=one, samp_num_coeff=sample, samp_den_coeff=one,
    )  # fmt: skip
    with rasterio.open(path, "r+") as dataset:
        dataset.rpcs = rpcs
    return path


@pytest.mark.parametrize("source_gsd_m", [None, 0.3])
def test_control_points_of_an_upright_sheet_place_it_as_its_transform_would(tmp_path, source_gsd_m):
    array = noise(200, 200)
    by_points = with_control_points(tmp_path / "a.tif", array, offset_m=0.05)
    (tmp_path / "b").mkdir()
    by_transform = write_image(tmp_path / "b" / "a.tif", array, crs="EPSG:2193", transform=PLACE)
    placed, record = tile([by_points], tmp_path / "placed", source_gsd_m=source_gsd_m)
    expected, _ = tile([by_transform], tmp_path / "expected")
    assert "a.tif: placed by its 4 ground control points" in record.notes
    assert record.sources[0]["crs"] == "EPSG:2193"
    bounds = [
        [
            one["properties"]["bounds"]
            for one in json.loads((tmp_path / name / "index.geojson").read_text())["features"]
        ]
        for name in ("placed", "expected")
    ]
    assert bounds[0] == [pytest.approx(one, abs=0.1) for one in bounds[1]]
    assert len(all_tiles(placed)) == len(all_tiles(expected)) == 9


def bent(path):
    return with_control_points(path, noise(200, 200), offset_m=9.0)


def on_one_line(path):
    return with_control_points(path, noise(200, 200), corners=((0, 0), (0, 0.5), (0, 1)))


@pytest.mark.parametrize(
    ("make", "named", "command"),
    [
        (bent, "ground control points", ""),
        (on_one_line, "ground control points", ""),
        (with_rpcs, "RPCs", "-rpc -to RPC_DEM=heights.tif "),
    ],
)
def test_what_bends_an_image_is_refused_or_left_out_in_a_note(tmp_path, make, named, command):
    path = make(tmp_path / "a.tif")
    expected = rf"placed by {named} alone.*gdalwarp {command}-r cubic -dstalpha a.tif warped.tif"
    with pytest.raises(ImageryError, match=expected):
        tile([path], tmp_path / "set")
    _, record = tile([path], tmp_path / "set", source_gsd_m=0.125)
    assert f"a.tif: its {named} are left out, because its metres per pixel are given" in (
        record.notes
    )
    assert record.sources[0]["gsd_m"] == [0.125, 0.125]


@pytest.mark.parametrize(
    ("system", "side", "gsd_m"),
    [
        (local("site grid", "metre", 1.0), 0.125, 0.125),
        (local("site grid", "US survey foot", FOOT_M), 0.5, 0.5 * FOOT_M),
        (local("Undefined", "unknown", 0.0), 0.125, 0.125),
    ],
)
def test_a_local_system_gives_its_unit(tmp_path, system, side, gsd_m):
    place = {"crs": system, "transform": from_origin(1000, 2000, side, side)}
    path = write_image(tmp_path / "a.tif", noise(200, 200), **place)
    _, record = tile([path], tmp_path / "own")
    assert record.sources[0]["crs"] is None
    assert record.sources[0]["gsd_m"] == pytest.approx([gsd_m, gsd_m], abs=1e-6)
    assert "a.tif: it names only a local reference system: its pixels" in record.notes[0]
    _, record = tile([path], tmp_path / "given", source_gsd_m=0.2)
    assert record.sources[0]["gsd_m"] == [0.2, 0.2]
    assert "a.tif: it names only a local reference system: its pixels" in record.notes[0]
    place |= {"transform": from_origin(1_550_000, 5_190_000, 0.125, 0.125)}
    path = write_image(tmp_path / "b.tif", noise(200, 200), **place)
    _, record = tile([path], tmp_path / "placed", crs="EPSG:2193")
    assert record.sources[0]["crs"] == "EPSG:2193"


def test_a_local_system_in_another_unit_is_one_sentence(tmp_path):
    place = {"crs": local("mine", "kilometre", 1000.0), "transform": from_origin(1, 2, 0.1, 0.1)}
    path = write_image(tmp_path / "a.tif", noise(200, 200), **place)
    expected = r"pixels of 100 x 100 but names only a local reference system; give it with --source"
    with pytest.raises(ImageryError, match=expected):
        tile([path], tmp_path / "set")


@pytest.mark.parametrize("georeferenced", [True, False])
def test_pixels_of_millimetres_are_doubted(tmp_path, georeferenced):
    place = {"crs": "EPSG:2193", "transform": from_origin(1_550_000, 5_190_000, 0.005, 0.005)}
    write_image(tmp_path / "a.tif", noise(200, 200), **(place if georeferenced else {}))
    given = {"gsd_m": 0.005, "source_gsd_m": None if georeferenced else 0.005}
    _, record = tile([tmp_path / "a.tif"], tmp_path / "set", **given)
    assert any("0.5 cm per pixel is finer than nearly all imagery" in one for one in record.notes)


def test_a_resolution_given_beside_the_stated_one_is_told(tmp_path):
    path = write_image(tmp_path / "a.tif", noise(200, 200), crs="EPSG:2193", transform=PLACE)
    for given_m, told in ((0.25, True), (PLACE.a, False)):
        _, record = tile([path], tmp_path / f"{told}", source_gsd_m=given_m)
        assert any("0.25 m given do not count" in note for note in record.notes) == told


def test_hidden_files_are_no_images(tmp_path):
    path = write_image(tmp_path / "a.tif", noise(200, 200), crs="EPSG:2193", transform=PLACE)
    (tmp_path / "._a.tif").write_bytes(b"Mac OS X")
    assert find_images([tmp_path]) == [path]
