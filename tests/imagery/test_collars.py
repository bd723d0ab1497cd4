"""Collars without a nodata value: left out, and never the shadows and roofs inside an image."""

import numpy as np
import pytest
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin
from rasterio.windows import Window
from scipy.ndimage import minimum_filter

from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles import collars
from skyproof.imagery.tiles.sources import SourceReader, inspect_source, read_mask
from tests.imagery.made import all_tiles, noise, tile, write_image

SIDE = 700
PLACE = {"crs": "EPSG:32633", "transform": from_origin(500_000, 5_300_000, 0.125, 0.125)}
WORLD = "0.125\n0\n0\n-0.125\n500000.0625\n5299999.9375\n"


def sheet(value, *, turn_deg=12.0, depth=np.uint8):
    """A slanted sheet in a collar of one value, with a roof and a shadow; and where it lies."""
    rows, columns = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    turn = np.radians(turn_deg)
    across = np.abs(columns * np.cos(turn) + rows * np.sin(turn))
    down = np.abs(rows * np.cos(turn) - columns * np.sin(turn))
    half = SIDE / 2 / (np.cos(turn) + np.sin(turn))
    inside = (across <= half) & (down <= half)
    full = np.iinfo(depth).max
    # Blocks of 16 px, of grey, so that lossy compression keeps their level.
    blocks = np.random.default_rng(0).uniform(0.3, 0.8, (SIDE // 16 + 1,) * 2) * full
    array = np.kron(blocks, np.ones((16, 16)))[None, :SIDE, :SIDE].repeat(3, 0).astype(depth)
    array[:, 300:370, 300:370] = full
    array[:, 400:470, 300:370] = 0
    array[:, ~inside] = value
    return array, inside


def with_alpha(path, array, inside):
    alpha = np.where(inside, np.iinfo(array.dtype).max, 0).astype(array.dtype)[None]
    kinds = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
    return write_image(path, np.concatenate([array, alpha]), colours=kinds, **PLACE)


def pictures(backgrounds):
    return {one.offset_px: backgrounds.pixels(one.id).numpy() for one in all_tiles(backgrounds)}


@pytest.mark.parametrize("turn_deg", [12.0, 1.0, 45.0])
@pytest.mark.parametrize(("value", "depth"), [(0, "uint8"), (255, "uint8"), (65535, "uint16")])
def test_a_collar_is_as_good_as_an_alpha_band(tmp_path, value, depth, turn_deg, monkeypatch):
    # More than one strip.
    monkeypatch.setattr(collars, "_STRIP_PX", 100 * SIDE)
    array, inside = sheet(value, turn_deg=turn_deg, depth=np.dtype(depth))
    plain = write_image(tmp_path / "a.tif", array, **PLACE)
    masked = with_alpha(tmp_path / "b.tif", array, inside)
    found, record = tile([plain], tmp_path / "found")
    expected, other = tile([masked], tmp_path / "expected")
    colour = "black" if value == 0 else "white"
    assert f"a.tif: its {colour} collar is left out" in record.notes
    assert not any("collar" in note for note in other.notes)
    assert record.empty == other.empty > 0
    left, right = pictures(found), pictures(expected)
    assert left.keys() == right.keys()
    assert all((left[place] == right[place]).all() for place in left)


@pytest.mark.parametrize("form", ["jpeg", "jpeg nodata", "world file"])
def test_lossy_collars_are_left_out_with_their_spoilt_edge(tmp_path, form):
    array, inside = sheet(0)
    if form == "world file":
        Image.fromarray(array.transpose(1, 2, 0)).save(tmp_path / "a.jpg", quality=75)
        (tmp_path / "a.jgw").write_text(WORLD)
        path = tmp_path / "a.jpg"
    else:
        nodata = {"nodata": 0} if form == "jpeg nodata" else {}
        options = {"compress": "jpeg", "photometric": "ycbcr", "interleave": "pixel", **nodata}
        path = write_image(tmp_path / "a.tif", array, **PLACE, **options)
    with SourceReader() as reader:
        source = inspect_source(path, SourceSettings(crs="EPSG:32633"), reader)
        with reader.reading(path) as dataset:
            shown = read_mask(dataset, source, Window(0, 0, SIDE, SIDE)) > 0
    assert "its black collar is left out" in source.notes
    # A few pixels stay where a corner of the sheet and its spoilt edge touch the image's border.
    assert shown[~inside].sum() <= 20
    # No more than a block is lost. A nodata value of 0 empties the shadow as well.
    kept = minimum_filter(inside, 2 * 17 + 1)
    kept[390:480, 290:380] = False
    assert kept.mean() > 0.5
    assert shown[kept].all()
    assert shown[400:470, 300:370].all() == (form != "jpeg nodata")


def test_roofs_and_shadows_at_the_border_are_no_collar(tmp_path):
    array = noise(800, 800)
    array[:, :30, :30] = 255
    array[:, 300:500, :200] = 0
    array[:, 770:, 400:] = 255
    array[:, 770:, 790:] = 90
    path = write_image(tmp_path / "a.tif", array, **PLACE)
    _, record = tile([path], tmp_path / "set", size_px=80)
    assert not any("collar" in note for note in record.notes)
    assert record.empty == 0


def test_only_an_image_with_an_empty_corner_is_read_whole(tmp_path, monkeypatch):
    def fail(*_):
        raise AssertionError

    monkeypatch.setattr(collars, "_between", fail)
    path = write_image(tmp_path / "a.tif", noise(200, 200), **PLACE)
    tile([path], tmp_path / "plain")
    array, inside = sheet(0)
    tile([with_alpha(tmp_path / "b.tif", array, inside)], tmp_path / "masked")
    path = write_image(tmp_path / "c.tif", array, nodata=0, **PLACE)
    tile([path], tmp_path / "nodata")
    path = write_image(tmp_path / "d.tif", array, **PLACE)
    with pytest.raises(AssertionError):
        tile([path], tmp_path / "collar")
