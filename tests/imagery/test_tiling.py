"""Tiling: true ground resolution, anti-aliasing, one cell per place, splits by place, pairing."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from rasterio.transform import Affine, from_origin
from rasterio.warp import transform as transform_places
from scipy import ndimage

from skyproof.errors import ImageryError
from skyproof.imagery.settings import SourceSettings, tiling_for_images
from skyproof.imagery.tiles.grid import lay_grids
from skyproof.imagery.tiles.sources import inspect_sources
from skyproof.imagery.words import merged_notes
from skyproof.scenes.splits import SPLITS
from tests.imagery.made import all_tiles, noise, smooth_noise, tile, write_image

NZTM = "EPSG:2193"
# At 60 degrees north a Web Mercator metre is half a metre on the ground.
MERCATOR = ("EPSG:3857", from_origin(1_000_000, 8_399_738, 0.5, 0.5))
# One degree is 111.4 km * cos(60 degrees) eastwards and 111.4 km northwards there.
DEGREES = ("EPSG:4326", from_origin(10.0, 60.0, 0.25 / 55_800, 0.25 / 111_412))
FEET = ("EPSG:2263", from_origin(980_000, 200_000, 0.25 / 0.3048, 0.25 / 0.3048))
UTM = ("EPSG:32633", from_origin(500_000, 5_300_000, 0.25, 0.25))
TURNED = (
    "EPSG:32633",
    Affine.translation(500_000, 5_300_000) * Affine.rotation(30) * Affine.scale(0.25, -0.25),
)
CASES = {"utm": UTM, "mercator": MERCATOR, "degrees": DEGREES, "feet": FEET, "turned": TURNED}


def bounds_of(folder):
    features = json.loads((folder / "index.geojson").read_text())["features"]
    return {one["properties"]["id"]: one["properties"] for one in features}


@pytest.mark.parametrize("case", CASES)
def test_every_pixel_shows_the_ground_its_bounds_say(tmp_path, case):
    # The picture codes the place: red and green are column and row, so that a wrong scale, shift or
    # turn is seen.
    crs, affine = CASES[case]
    rows, columns = np.indices((400, 500))
    write_image(
        tmp_path / "a.tif",
        np.stack([columns / 2, rows / 2, rows * 0]).astype(np.uint8),
        crs=crs,
        transform=affine,
    )
    backgrounds, record = tile([tmp_path / "a.tif"], tmp_path / "set", gsd_m=0.25)
    assert record.sources[0]["gsd_m"] == pytest.approx([0.25, 0.25], rel=0.01)
    placed = bounds_of(tmp_path / "set")
    assert len(placed) >= 10
    for one in all_tiles(backgrounds):
        pixels = backgrounds.pixels(one.id).numpy().astype(float)
        left, bottom, right, top = placed[one.id]["bounds"]
        assert (right - left, top - bottom) == pytest.approx((16, 16))
        for row, column in ((20, 20), (20, 44), (44, 20), (44, 44)):
            x, y = left + (column + 0.5) * 0.25, top - (row + 0.5) * 0.25
            (x,), (y,) = transform_places(placed[one.id]["crs"], crs, [x], [y])
            expected_column, expected_row = ~affine * (x, y)
            # Half a grey value is a pixel.
            assert pixels[0, row, column] == pytest.approx((expected_column - 0.5) / 2, abs=1)
            assert pixels[1, row, column] == pytest.approx((expected_row - 0.5) / 2, abs=1)


def test_web_mercator_tiles_are_true_metres_on_the_ground(tmp_path):
    write_image(tmp_path / "a.tif", noise(400, 400), crs=MERCATOR[0], transform=MERCATOR[1])
    tile([tmp_path / "a.tif"], tmp_path / "set", gsd_m=0.25)
    for feature in json.loads((tmp_path / "set" / "index.geojson").read_text())["features"]:
        ring = feature["geometry"]["coordinates"][0]
        assert ring[0] == ring[-1]
        # On a sphere of the ellipsoid's size at 60 degrees: 16 m, to half a percent.
        (x0, y0), (x1, y1) = ring[0], ring[2]
        east, north = (
            math.radians(x1 - x0) * 6.389e6 * math.cos(math.radians(60)),
            math.radians(y1 - y0) * 6.386e6,
        )
        assert math.hypot(east, north) == pytest.approx(16 * math.sqrt(2), rel=0.005)
        area = sum(a[0] * b[1] - b[0] * a[1] for a, b in itertools.pairwise(ring))
        assert area > 0, "GeoJSON outlines run anticlockwise"
    latitude = 2 * math.atan(math.exp(MERCATOR[1].f / 6378137)) - math.pi / 2
    assert math.degrees(latitude) == pytest.approx(60, abs=0.01)


@pytest.mark.parametrize("georeferenced", [False, True])
def test_same_resolution_copies_pixels(tmp_path, georeferenced):
    array = noise(160, 160)
    place = (
        {"crs": NZTM, "transform": from_origin(1_550_000, 5_190_000, 0.125, 0.125)}
        if georeferenced
        else {}
    )
    write_image(tmp_path / "a.tif", array, **place)
    backgrounds, _ = tile([tmp_path / "a.tif"], tmp_path / "set", source_gsd_m=0.125)
    assert len(all_tiles(backgrounds)) == 4
    for one in all_tiles(backgrounds):
        left, top = one.offset_px
        assert np.array_equal(
            backgrounds.pixels(one.id).numpy(), array[:, top : top + 64, left : left + 64]
        )


@pytest.mark.parametrize("gsd_m", [0.05, 0.04, 0.03, 0.0625])
def test_fine_checkerboard_becomes_its_mean(tmp_path, gsd_m):
    rows, columns = np.indices((400, 400))
    board = np.where((rows + columns) % 2 == 0, 20, 220).astype(np.uint8)
    path = write_image(tmp_path / "a.tif", np.stack([board] * 3))
    backgrounds, _ = tile([path], tmp_path / "set", source_gsd_m=gsd_m)
    pixels = torch.cat(
        [backgrounds.pixels(one.id).flatten() for one in all_tiles(backgrounds)]
    ).float()
    assert float(pixels.mean()) == pytest.approx(120, abs=1.5)
    # Point sampling would give 20 and 220 (a deviation of 100) in a coarse false pattern.
    assert float(pixels.std()) < 12


def test_large_shrinking_is_read_in_pieces_without_seams(tmp_path, monkeypatch):
    path = write_image(tmp_path / "a.tif", smooth_noise(960, 960))
    whole, _ = tile([path], tmp_path / "whole", source_gsd_m=0.025)
    monkeypatch.setattr("skyproof.imagery.tiles.warp.PIECE_PX", 100)
    pieces, _ = tile([path], tmp_path / "pieces", source_gsd_m=0.025)
    for one in all_tiles(whole):
        assert torch.equal(whole.pixels(one.id), pieces.pixels(one.id))


def test_overlapping_sources_share_cells_and_splits(tmp_path):
    # Two sheets of one landscape that overlap, with an odd shift, in two reference systems' order
    # of naming.
    scene = smooth_noise(700, 1200)
    for name, start in (("a", 0), ("b", 450)):
        part = scene[:, :, start : start + 750]
        write_image(
            tmp_path / f"{name}.tif",
            part,
            crs=NZTM,
            transform=from_origin(1_550_003 + start / 8, 5_190_001, 0.125, 0.125),
        )
    both, _ = tile([tmp_path / "a.tif", tmp_path / "b.tif"], tmp_path / "both")
    ids = [one.id for one in all_tiles(both)]
    assert len(ids) == len(set(ids)) == len(bounds_of(tmp_path / "both"))
    boxes = [tuple(one["bounds"]) for one in bounds_of(tmp_path / "both").values()]
    assert all(
        a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        for i, a in enumerate(boxes)
        for b in boxes[:i]
    )
    # The first that shows a cell gives it; the second alone is cut into the very same cells.
    assert {one.source for one in all_tiles(both)} == {"a.tif", "b.tif"}
    alone, _ = tile([tmp_path / "b.tif"], tmp_path / "alone")
    assert {one.id for one in all_tiles(alone)} < set(ids)


def test_a_cell_on_the_seam_of_two_sheets_is_put_together(tmp_path):
    scene = smooth_noise(600, 1200)
    for name, start in (("east", 600), ("west", 0)):
        write_image(
            tmp_path / f"{name}.tif", scene[:, :, start : start + 600], crs=NZTM,
            transform=from_origin(1_550_004 + start / 8, 5_190_004, 0.125, 0.125),
        )  # fmt: skip
    backgrounds, _ = tile([tmp_path], tmp_path / "set")
    joined = [one for one in all_tiles(backgrounds) if one.source == "east.tif + west.tif"]
    assert len(joined) >= 7
    placed = bounds_of(tmp_path / "set")
    for one in all_tiles(backgrounds):
        left, _, _, top = placed[one.id]["bounds"]
        column, row = round((left - 1_550_004) * 8), round((5_190_004 - top) * 8)
        assert np.array_equal(
            backgrounds.pixels(one.id).numpy(), scene[:, row : row + 64, column : column + 64]
        )


def test_touching_map_tiles_are_one_map(tmp_path):
    # 7 x 7 tiles of 256 px at zoom 20 above Munich, some 26 m each.
    side = 2 * math.pi * 6378137 / 2**20
    corner = 558_060 * side - math.pi * 6378137, math.pi * 6378137 - 364_070 * side
    scene, transform = smooth_noise(1792, 1792), from_origin(*corner, side / 256, side / 256)
    folder = tmp_path / "town"
    folder.mkdir()
    for across in range(7):
        for down in range(7):
            place = folder / f"{across}_{down}.png"
            part = scene[:, down * 256 : down * 256 + 256, across * 256 : across * 256 + 256]
            Image.fromarray(part.transpose(1, 2, 0)).save(place)
            left, top = transform * (across * 256, down * 256)
            half = transform.a / 2
            lines = (transform.a, 0, 0, -transform.a, left + half, top - half)
            place.with_suffix(".pgw").write_text("\n".join(map(repr, lines)))
    write_image(tmp_path / "whole.tif", scene, crs="EPSG:3857", transform=transform)
    joined, record = tile([folder], tmp_path / "joined", size_px=300, crs="EPSG:3857")
    whole, _ = tile([tmp_path / "whole.tif"], tmp_path / "set", size_px=300)
    assert {one.source for one in all_tiles(joined)} == {"town"}
    assert len(record.sources) == 49
    assert len(merged_notes(record.notes)) < 4
    names = {one.id for one in all_tiles(joined)}
    assert len(names) >= 4
    assert names == {one.id for one in all_tiles(whole)}
    for name in names:
        difference = joined.pixels(name).float() - whole.pixels(name).float()
        # Seams are a little less sharp or smooth than what is read through.
        assert difference.abs().mean() < 1.0
        assert difference.abs().max() < 30


def test_imagery_across_a_zone_border_has_one_grid(tmp_path):
    # Longitude 12 is the border of UTM zones 32 and 33.
    write_image(
        tmp_path / "a.tif",
        noise(100, 400),
        crs="EPSG:4326",
        transform=from_origin(11.9997, 48, 1e-6, 1e-6),
    )
    write_image(
        tmp_path / "b.tif",
        noise(100, 400),
        crs="EPSG:4326",
        transform=from_origin(12.0, 48, 1e-6, 1e-6),
    )
    tile([tmp_path / "a.tif", tmp_path / "b.tif"], tmp_path / "set", size_px=40)
    assert {one["crs"] for one in bounds_of(tmp_path / "set").values()} == {"EPSG:32632"}


def test_images_without_georeference_have_frames_of_their_own(tmp_path):
    write_image(tmp_path / "a.tif", noise(420, 500))
    write_image(tmp_path / "b.tif", noise(130, 90))
    backgrounds, _ = tile([tmp_path], tmp_path / "set", source_gsd_m=0.125)
    assert {one.offset_px for one in all_tiles(backgrounds) if one.source == "b.tif"} == {
        (0, 0),
        (0, 64),
    }
    assert len(all_tiles(backgrounds)) == 6 * 7 + 2
    assert bounds_of(tmp_path / "set") == {}


@pytest.mark.parametrize("stem", ["2024-06-20T13:00:00", "a\\b", "a\nb", "a" * 140])
def test_a_name_that_no_tile_can_bear_is_refused(tmp_path, stem):
    path = write_image(tmp_path / "a.tif", noise(64, 64)).rename(tmp_path / f"{stem}.tif")
    with pytest.raises(ImageryError, match=r"bear its name, .*; rename the image") as caught:
        tile([path], tmp_path / "set", source_gsd_m=0.125)
    assert "\n" not in str(caught.value)
    # Tiles of georeferenced images are called by their place.
    path = write_image(
        tmp_path / "a.tif", noise(64, 64), crs=NZTM,
        transform=from_origin(1_550_000, 5_190_000, 0.125, 0.125),
    ).rename(tmp_path / f"{stem}.tif")  # fmt: skip
    tile([path], tmp_path / "placed")


def test_the_longest_names_are_read_again(tmp_path):
    stem = "a" * 134
    path = write_image(tmp_path / "a.tif", noise(64, 64)).rename(tmp_path / f"{stem}.tif")
    backgrounds, _ = tile([path], tmp_path / "set", source_gsd_m=0.125)
    assert [one.id for one in all_tiles(backgrounds)] == [f"{stem}-00000-00000"]


def test_small_images_shrink_their_tiles_where_that_is_allowed(tmp_path):
    write_image(tmp_path / "a.tif", noise(100, 100))
    backgrounds, _ = tile(
        [tmp_path / "a.tif"], tmp_path / "set", source_gsd_m=0.125, size_px=100, minimum_px=40
    )
    assert [len(backgrounds.tiles(split)) for split in SPLITS] == [1, 1, 1, 1]
    write_image(tmp_path / "large.tif", noise(300, 300))
    backgrounds, _ = tile(
        [tmp_path], tmp_path / "mixed", source_gsd_m=0.125, size_px=120, minimum_px=40
    )
    sizes = {one.source: one.width_px for one in all_tiles(backgrounds)}
    assert sizes == {"a.tif": 96, "large.tif": 120}


SCENES = tiling_for_images(192, gsd_m=0.125, imagery=True)
"""Tiles for scenes of 24 m, which turn freely on 34.25 m."""


def tiles_for_scenes(folder, settings=SCENES, **shapes_m):
    """Cuts images of those widths and heights in metres; gives sides and numbers of tiles."""
    for name, (width_m, height_m) in shapes_m.items():
        write_image(folder / f"{name}.tif", noise(round(height_m / 0.05), round(width_m / 0.05)))
    sources = inspect_sources([folder], SourceSettings(gsd_m=0.05))
    notes: list[str] = []
    grids = lay_grids(sources, settings, notes)
    return {grid.name: (grid.side_m, grid.whole_cells()) for grid in grids}, notes


@pytest.mark.parametrize(
    ("shape_m", "side_m", "count"),
    [
        # Crops of 640 px at 5 cm, the smallest that serve, and those that today's tiles fit.
        ((32, 32), 32, 1),
        ((24, 40), 24, 1),
        ((34.25, 34.25), 34.25, 1),
        ((45, 45), 41.125, 1),
        # Two tiles of 30 m use more ground than one of 32.
        ((60, 32), 30, 2),
        ((30, 36), 30, 1),
    ],
)
def test_small_images_give_the_largest_tiles_that_use_their_ground(
    tmp_path, shape_m, side_m, count
):
    large = dict.fromkeys(("x", "y"), (120, 90))
    found, notes = tiles_for_scenes(tmp_path, **large, a=shape_m)
    assert found["a"] == pytest.approx((side_m, count))
    # Images of one size do not change the tiles of others.
    assert found["x"] == found["y"] == pytest.approx((51.375, 2))
    turns = [note for note in notes if "are turned there by at most" in note]
    assert len(turns) == (side_m < 34.25)
    assert all(f"tiles of {side_m:.1f} m from a.tif" in note for note in turns)


def test_too_small_images_are_counted_in_metres(tmp_path):
    small = dict.fromkeys("abcd", (23, 60))
    found, notes = tiles_for_scenes(tmp_path, **small, big=(160, 160))
    assert found.keys() == {"big"}
    assert merged_notes(notes) == [
        "5 images without georeference show at most 5 distinct places",
        "4 images (a.tif, b.tif and 2 more): too small for a tile of 24.0 m, and left out",
    ]
    assert "c.tif: too small for a tile of 24.0 m, and left out" in notes
    (tmp_path / "big.tif").unlink()
    with pytest.raises(ImageryError, match=r"23\.0 x 60\.0 m, .* takes 24\.0 m on each side"):
        tiles_for_scenes(tmp_path)


def test_few_small_images_give_a_tile_for_every_split(tmp_path):
    three = tiling_for_images(192, gsd_m=0.125, imagery=True)
    three = dataclasses.replace(three, shares=(0.0, 0.25, 0.25, 0.5))
    # At 34.25 m it holds two tiles.
    found, _ = tiles_for_scenes(tmp_path, three, a=(73, 35))
    assert found == {"a": (pytest.approx(24.25), 3)}


def test_splits_without_a_tile_are_named_in_one_note(tmp_path):
    write_image(tmp_path / "one.tif", noise(70, 70), crs=UTM[0], transform=UTM[1])
    _, record = tile([tmp_path / "one.tif"], tmp_path / "set", gsd_m=0.25)
    (note,) = [note for note in record.notes if "too few tiles" in note]
    assert "too few tiles for validation, attack and test; give more" in note


def test_at_27_cm_a_tile_need_not_be_larger_than_a_scene(tmp_path):
    # 96 px of 27 cm are 25.9 m.
    settings = tiling_for_images(96, gsd_m=0.27, imagery=True)
    found, _ = tiles_for_scenes(tmp_path, settings, **dict.fromkeys("abcd", (30, 26)))
    assert found == {name: (pytest.approx(25.92), 1) for name in "abcd"}


def test_crops_apart_on_a_map_go_to_all_splits(tmp_path):
    for number in range(8):
        place = from_origin(500_000 + 1000 * number, 5_300_000, 0.125, 0.125)
        write_image(tmp_path / f"{number}.tif", noise(100, 100), crs="EPSG:32633", transform=place)
    backgrounds, record = tile([tmp_path], tmp_path / "set", size_px=100)
    assert all(backgrounds.tiles(split) for split in SPLITS)
    assert len(record.blocks_m) == 8


def test_png_and_determinism(tmp_path):
    Image.fromarray(noise(200, 200).transpose(1, 2, 0)).save(tmp_path / "a.png")
    Image.fromarray(noise(200, 240).transpose(1, 2, 0)).save(tmp_path / "b.jpg")
    paths = [tmp_path / "a.png", tmp_path / "b.jpg"]
    tile(paths, tmp_path / "s1", source_gsd_m=0.1)
    tile(paths, tmp_path / "s2", source_gsd_m=0.1)
    files = sorted(file.relative_to(tmp_path / "s1") for file in (tmp_path / "s1").rglob("*.*"))
    assert len(files) > 8
    for file in files:
        assert (tmp_path / "s1" / file).read_bytes() == (tmp_path / "s2" / file).read_bytes()


def test_vehicles_will_be_drawn_as_sharp_as_the_imagery(tmp_path):
    checks = np.kron(np.indices((16, 16)).sum(0) % 2, np.ones((40, 40)))
    light = ndimage.gaussian_filter(np.where(checks > 0, 0.5, 0.1), 1.0)
    srgb = ((1.055 * light ** (1 / 2.4) - 0.055) * 255).round().astype(np.uint8)
    write_image(tmp_path / "a.tif", np.repeat(srgb[None], 3, 0), crs=UTM[0], transform=UTM[1])
    backgrounds, record = tile([tmp_path / "a.tif"], tmp_path / "set", gsd_m=0.25, size_px=128)
    assert backgrounds.sensor.blur_sigma_px == pytest.approx(1.0, rel=0.1)
    assert any("blur measured" in note for note in record.notes)
