"""Masks of crowns and roofs, cut as their orthophotos are."""

import numpy as np
import pytest
from PIL import Image
from rasterio.crs import CRS
from rasterio.transform import Affine

from skyproof.errors import ImageryError
from tests.imagery.made import all_tiles, noise, tile, write_image

NORTH_UP = Affine(0.125, 0, 500_000, 0, -0.125, 5_330_000)
UTM = CRS.from_epsg(32632)


@pytest.fixture
def photos(tmp_path):
    """Two orthophotos side by side, with a mask each: black at the left, white at the right."""
    for name, shift in (("a", 0), ("b", 192)):
        place = NORTH_UP * Affine.translation(shift, 0)
        (tmp_path / "photos").mkdir(exist_ok=True)
        (tmp_path / "masks").mkdir(exist_ok=True)
        write_image(tmp_path / "photos" / f"{name}.tif", noise(192, 192), crs=UTM, transform=place)
        mask = np.zeros((1, 192, 192), np.uint8)
        mask[:, :, 96:] = 255 if name == "a" else 1
        # One mask knows its place, the other does not; one names its zeros as no data.
        known = {"crs": UTM, "transform": place} if name == "a" else {"nodata": 0}
        write_image(tmp_path / "masks" / f"{name}.tif", mask, **known)
    return tmp_path


def cut(photos, **said):
    return tile([photos / "photos"], photos / "set", **said)


def test_masks_are_cut_as_their_photographs_are(photos):
    backgrounds, record = cut(photos, cover=photos / "masks")
    assert record.settings["cover"] == str(photos / "masks")
    tiles = all_tiles(backgrounds)
    assert len(tiles) >= 12
    # Each tile's own pixels say which column of the photograph it shows.
    seen = 0
    for one in tiles:
        cover = backgrounds.cover(one.id)
        pixels = backgrounds.pixels(one.id).numpy()
        for left in range(0, 384, 64):
            column = left % 192
            if np.array_equal(pixels[:, 0], noise(192, 192)[:, 0, column : column + 64]):
                expected = np.zeros((64, 64), np.uint8)
                expected[:, max(0, 96 - column) :] = 255
                found = np.zeros((64, 64)) if cover is None else cover.numpy()
                assert np.array_equal(found, expected)
                seen += 1
    assert seen


def test_a_mask_that_is_missing_or_of_another_size_is_refused(photos):
    (photos / "masks" / "b.tif").unlink()
    with pytest.raises(ImageryError, match=r"holds no mask for b\.tif; add an image of the same"):
        cut(photos, cover=photos / "masks")
    write_image(photos / "masks" / "b.tif", np.zeros((1, 100, 192), np.uint8))
    with pytest.raises(ImageryError, match=r"192 x 100 pixels and b\.tif 192 x 192; give a mask"):
        cut(photos, cover=photos / "masks")
    assert not (photos / "set" / "index.json").exists()


def test_one_mask_of_one_photograph_may_have_any_name(photos):
    (photos / "photos" / "b.tif").unlink()
    backgrounds, _ = cut(photos, cover=photos / "masks" / "b.tif")
    assert any(one.cover for one in all_tiles(backgrounds))


def test_masks_of_map_tiles_are_told_apart_by_their_column(tmp_path):
    # 26 m at zoom 20, white in the eastern column.
    for across in (0, 1):
        place = f"20/{558_060 + across}/364070.png"
        for folder, pixels in (
            ("town", noise(256, 256)),
            ("masks", np.full((3, 256, 256), 255 * across, np.uint8)),
        ):
            (tmp_path / folder / place).parent.mkdir(parents=True)
            Image.fromarray(pixels.transpose(1, 2, 0)).save(tmp_path / folder / place)
    backgrounds, _ = tile([tmp_path / "town"], tmp_path / "set", cover=tmp_path / "masks")
    tiles = all_tiles(backgrounds)
    assert {one.source for one in tiles} == {"town"}
    middle = np.mean([one.offset_px[0] for one in tiles])
    for one in tiles:
        cover = backgrounds.cover(one.id)
        if one.offset_px[0] < middle - 64:
            assert cover is None
        if one.offset_px[0] > middle + 64:
            assert cover.numpy().mean() > 250


def test_without_masks_nothing_is_covered(photos):
    backgrounds, _ = cut(photos)
    assert not any(one.cover for one in all_tiles(backgrounds))
