"""Orthophoto tiling: true ground resolution, anti-aliasing, splits disjoint in place, bad input."""

import math
import warnings

import numpy as np
import pytest
import rasterio
import torch
from PIL import Image
from rasterio.transform import Affine, from_origin

from skyproof.errors import ImageryError
from skyproof.scenes.backgrounds import SPLITS
from skyproof.scenes.orthophotos import SPLIT_SHARES, tile_orthophotos


def _write(path, array, *, crs=None, transform=None, **options):
    count, height, width = array.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            path, "w", driver="GTiff", width=width, height=height, count=count, dtype=array.dtype.name, crs=crs,
            transform=transform or Affine.identity(), **options,
        ) as dataset:  # fmt: skip
            dataset.write(array)


def _noise(height, width, count=3):
    return np.random.default_rng(0).integers(1, 255, (count, height, width), dtype=np.uint8)


def _tile(paths, folder, **options):
    settings = {"tile_px": 64, "minimum_tile_px": 40, "generator": torch.Generator().manual_seed(0)} | options
    return tile_orthophotos(paths, folder, **settings)


def _all(backgrounds):
    return [tile for split in SPLITS for tile in backgrounds.tiles(split)]


def _extent(backgrounds):
    tiles = _all(backgrounds)
    return max(t.offset_px[0] + t.width_px for t in tiles), max(t.offset_px[1] + t.height_px for t in tiles)


UTM = ("EPSG:32633", from_origin(500_000, 5_300_000, 0.25, 0.25), 0.25, 0.25)
# At 60 degrees north a Web Mercator metre is half a metre on the ground; the ellipsoid adds up to 0.7 %.
MERCATOR = ("EPSG:3857", from_origin(1_000_000, 8_399_738, 0.5, 0.5), 0.25, 0.25)
# One degree is 111.4 km * cos(60 degrees) eastwards and 111.4 km northwards there.
DEGREES = ("EPSG:4326", from_origin(10.0, 60.0, 0.25 / 55_800, 0.25 / 111_412), 0.25, 0.25)
FEET = ("EPSG:2263", from_origin(980_000, 200_000, 0.25 / 0.3048, 0.25 / 0.3048), 0.25, 0.25)


@pytest.mark.parametrize("case", [UTM, MERCATOR, DEGREES, FEET], ids=["utm", "mercator", "degrees", "feet"])
def test_ground_resolution_is_true(tmp_path, case):
    crs, transform, gsd_x, gsd_y = case
    _write(tmp_path / "a.tif", _noise(200, 300), crs=crs, transform=transform)
    width, height = _extent(_tile([tmp_path / "a.tif"], tmp_path / "set", gsd_m=0.5))
    assert width == pytest.approx(300 * gsd_x / 0.5, rel=0.01)
    assert height == pytest.approx(200 * gsd_y / 0.5, rel=0.01)


def test_same_resolution_copies_pixels(tmp_path):
    array = _noise(160, 160)
    _write(tmp_path / "a.tif", array)
    backgrounds = _tile([tmp_path / "a.tif"], tmp_path / "set", assumed_gsd_m=0.125)
    for tile in _all(backgrounds):
        left, top = tile.offset_px
        expected = array[:, top : top + tile.height_px, left : left + tile.width_px]
        assert np.array_equal(backgrounds.pixels(tile.id).numpy(), expected)


@pytest.mark.parametrize("gsd_m", [0.05, 0.04, 0.03, 0.0625])
def test_fine_checkerboard_becomes_its_mean(tmp_path, gsd_m):
    rows, columns = np.indices((400, 400))
    board = np.where((rows + columns) % 2 == 0, 20, 220).astype(np.uint8)
    _write(tmp_path / "a.tif", np.stack([board] * 3))
    tiles = _tile([tmp_path / "a.tif"], tmp_path / "set", assumed_gsd_m=gsd_m)
    pixels = torch.cat([tiles.pixels(tile.id).flatten() for tile in _all(tiles)]).float()
    assert float(pixels.mean()) == pytest.approx(120, abs=1.5)
    # Point sampling would give 20 and 220 (a deviation of 100) in a coarse false pattern.
    assert float(pixels.std()) < 12


def test_splits_do_not_share_ground_and_all_serve(tmp_path):
    _write(tmp_path / "a.tif", _noise(420, 500))
    _write(tmp_path / "b.tif", _noise(130, 90))
    backgrounds = _tile([tmp_path], tmp_path / "set", assumed_gsd_m=0.125)
    for source in ("a.tif", "b.tif"):
        owner = np.zeros((420, 500), int)
        for number, split in enumerate(SPLITS, 1):
            for tile in backgrounds.tiles(split):
                if tile.source == source:
                    left, top = tile.offset_px
                    region = owner[top : top + tile.height_px, left : left + tile.width_px]
                    assert (region == 0).all(), "two tiles share ground"
                    region[:] = number
    total = len(_all(backgrounds))
    for split in SPLITS:
        share = len(backgrounds.tiles(split)) / total
        assert share == pytest.approx(SPLIT_SHARES[split], abs=1.5 / total + 0.01)
    assert all(min(tile.width_px, tile.height_px) >= 40 for tile in _all(backgrounds))


def test_blocks_shrink_until_every_split_has_one(tmp_path):
    _write(tmp_path / "a.tif", _noise(100, 100))
    backgrounds = _tile([tmp_path / "a.tif"], tmp_path / "set", assumed_gsd_m=0.125, tile_px=100)
    assert [len(backgrounds.tiles(split)) for split in SPLITS] == [1, 1, 1, 1]


def test_empty_blocks_are_dropped(tmp_path):
    array = _noise(192, 192)
    array[:, :64, :64] = 0
    alpha = np.full((1, 192, 192), 255, np.uint8)
    alpha[:, 130:, 130:] = 0
    _write(tmp_path / "nodata.tif", array, nodata=0)
    _write(tmp_path / "alpha.tif", np.concatenate([_noise(192, 192), alpha]), photometric="RGB", alpha="YES")
    offsets = {tile.offset_px for tile in _all(_tile([tmp_path / "nodata.tif"], tmp_path / "s1", assumed_gsd_m=0.125))}
    assert len(offsets) == 8
    assert (0, 0) not in offsets
    offsets = {tile.offset_px for tile in _all(_tile([tmp_path / "alpha.tif"], tmp_path / "s2", assumed_gsd_m=0.125))}
    assert len(offsets) == 8
    assert (128, 128) not in offsets


def test_sixteen_bits_and_one_band(tmp_path):
    ramp = np.tile(np.linspace(1000, 3000, 200), (200, 1)).astype(np.uint16)
    _write(tmp_path / "deep.tif", np.stack([ramp] * 3))
    deep = _tile([tmp_path / "deep.tif"], tmp_path / "s1", assumed_gsd_m=0.125)
    values = torch.cat([deep.pixels(tile.id).flatten() for tile in _all(deep)]).float()
    assert float(values.min()) == 0
    assert float(values.max()) == 255
    assert float(values.mean()) == pytest.approx(127.5, abs=2)
    _write(tmp_path / "grey.tif", _noise(200, 200, 1))
    grey = _tile([tmp_path / "grey.tif"], tmp_path / "s2", assumed_gsd_m=0.125)
    pixels = grey.pixels(_all(grey)[0].id)
    assert torch.equal(pixels[0], pixels[2])


def test_png_with_resolution_and_determinism(tmp_path):
    Image.fromarray(_noise(200, 200).transpose(1, 2, 0)).save(tmp_path / "a.png")
    Image.fromarray(_noise(200, 240).transpose(1, 2, 0)).save(tmp_path / "b.jpg")
    paths = [tmp_path / "a.png", tmp_path / "b.jpg"]
    _tile(paths, tmp_path / "s1", assumed_gsd_m=0.1)
    _tile(paths, tmp_path / "s2", assumed_gsd_m=0.1)
    files = sorted(file.relative_to(tmp_path / "s1") for file in (tmp_path / "s1").rglob("*.*"))
    assert len(files) > 8
    for file in files:
        assert (tmp_path / "s1" / file).read_bytes() == (tmp_path / "s2" / file).read_bytes()


def _broken(folder):
    (folder / "x.tif").write_bytes(b"no image at all")


def _truncated(folder):
    _write(folder / "x.tif", _noise(200, 200))
    data = (folder / "x.tif").read_bytes()
    (folder / "x.tif").write_bytes(data[: len(data) // 2])


def _plain(folder):
    _write(folder / "x.tif", _noise(200, 200))


def _picture(folder):
    Image.fromarray(_noise(200, 200).transpose(1, 2, 0)).save(folder / "x.png")


def _coarse(folder):
    _write(folder / "x.tif", _noise(200, 200), crs="EPSG:32633", transform=from_origin(5e5, 5e6, 0.6, 0.6))


def _small(folder):
    _write(folder / "x.tif", _noise(30, 200))


def _few(folder):
    _write(folder / "x.tif", _noise(70, 100))


def _hollow(folder):
    _write(folder / "x.tif", np.zeros((3, 200, 200), np.uint8), nodata=0)


@pytest.mark.parametrize(
    ("make", "gsd_m", "message"),
    [
        (lambda folder: None, None, "holds no image"),
        (_broken, 0.125, "cannot be read"),
        (_truncated, 0.125, "cannot be read"),
        (_plain, None, "--gsd"),
        (_picture, None, "--gsd"),
        (_coarse, None, "0.60 m per pixel"),
        (_plain, 0.7, "0.70 m per pixel"),
        (_small, 0.125, "30 px wide"),
        (_few, 0.125, "2 blocks of 40 px"),
        (_hollow, 0.125, "Only 0 blocks"),
    ],
)
def test_bad_imagery_is_one_clear_sentence(tmp_path, make, gsd_m, message):
    folder = tmp_path / "imagery"
    folder.mkdir()
    make(folder)
    with pytest.raises(ImageryError, match=message) as caught:
        _tile([folder], tmp_path / "set", assumed_gsd_m=gsd_m)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "set" / "index.json").exists()


def test_missing_and_namesake_images(tmp_path):
    with pytest.raises(ImageryError, match=r"none\.tif is missing"):
        _tile([tmp_path / "none.tif"], tmp_path / "set")
    _plain(tmp_path)
    _picture(tmp_path)
    with pytest.raises(ImageryError, match="shares its name"):
        _tile([tmp_path], tmp_path / "set", assumed_gsd_m=0.125)


def test_latitude_of_the_mercator_case():
    # The Mercator case above really lies at 60 degrees north.
    northing = MERCATOR[1].f
    latitude = 2 * math.atan(math.exp(northing / 6378137)) - math.pi / 2
    assert math.degrees(latitude) == pytest.approx(60, abs=0.01)
