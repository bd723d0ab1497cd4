"""Orthophotos as they come: bands, depths, nodata, alpha, world files, and what is refused."""

from datetime import UTC, datetime

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.transform import Affine, from_origin

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.sources import find_images, inspect_sources
from tests.imagery.made import all_tiles, noise, tile, write_image

UTM = {"crs": "EPSG:32633", "transform": from_origin(500_000, 5_300_000, 0.125, 0.125)}
GREY, RED, GREEN, BLUE = ColorInterp.gray, ColorInterp.red, ColorInterp.green, ColorInterp.blue
NIR, ALPHA, UNDEFINED = ColorInterp.nir, ColorInterp.alpha, ColorInterp.undefined


def bands(*values, dtype=np.uint8):
    """Flat bands of 200 x 200 px."""
    return np.stack([np.full((200, 200), value, dtype) for value in values])


def colour_of(backgrounds):
    """The colour of the middle of the first tile."""
    return backgrounds.pixels(all_tiles(backgrounds)[0].id)[:, 30, 30].tolist()


@pytest.mark.parametrize(
    ("array", "colours", "expected", "note"),
    [
        (bands(10, 20, 30), (RED, GREEN, BLUE), [10, 20, 30], None),
        (bands(10, 20, 30), (BLUE, GREEN, RED), [30, 20, 10], None),
        (
            bands(90, 10, 20, 30),
            (NIR, RED, GREEN, BLUE),
            [10, 20, 30],
            "red, green and blue are taken (2, 3, 4)",
        ),
        (
            bands(90, 10, 20),
            (NIR, RED, GREEN),
            [90, 10, 20],
            "its band 1 is infrared and it has no blue",
        ),
        (
            bands(10, 20, 30, 90),
            (GREY, *[UNDEFINED] * 3),
            [10, 20, 30],
            "does not say which are colours",
        ),
        (
            bands(10, 20, 30, 90),
            (RED, GREEN, BLUE, ALPHA),
            [10, 20, 30],
            "tagged as alpha but holds a picture",
        ),
        (bands(40), (GREY,), [40, 40, 40], None),
        (bands(40, 255), (GREY, ALPHA), [40, 40, 40], None),
        (bands(40, 70), (GREY, UNDEFINED), [40, 40, 40], "band 1 is taken as grey"),
    ],
)
def test_bands_become_colours(tmp_path, array, colours, expected, note):
    write_image(tmp_path / "a.tif", array, colours=colours, **UTM)
    backgrounds, record = tile([tmp_path / "a.tif"], tmp_path / "set")
    assert colour_of(backgrounds) == expected
    # What is said of blur and light is not about bands.
    others = ("blur", "exposure", "night")
    said = (note for note in record.notes if not any(word in note for word in others))
    notes = " ".join(said)
    assert (note or "") in notes
    assert note is not None or notes == ""


def test_band_names_serve_where_interpretation_is_missing(tmp_path):
    path = write_image(
        tmp_path / "a.tif", bands(10, 20, 30, 90), colours=(GREY, *[UNDEFINED] * 3), **UTM
    )

    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = ("NIR", "Red", "Green", "Blue")
    backgrounds, _ = tile([path], tmp_path / "set")
    assert colour_of(backgrounds) == [20, 30, 90]


@pytest.mark.parametrize("depth", ["uint16", "int16", "float32"])
def test_deep_values_get_one_range_per_source(tmp_path, depth):
    ramp = np.tile(np.linspace(1000, 3000, 200), (200, 1)).astype(depth)
    write_image(tmp_path / "deep.tif", np.stack([ramp] * 3), **UTM)
    backgrounds, record = tile([tmp_path / "deep.tif"], tmp_path / "set")
    low, high = record.sources[0]["value_range"]
    assert (low, high) == pytest.approx((1020, 2980), abs=12)
    for one in all_tiles(backgrounds):
        row = backgrounds.pixels(one.id)[0, 30].numpy().astype(float)
        # One range for all tiles: a column's value does not depend on its tile.
        columns = one.offset_px[0] + np.arange(64)
        expected = np.clip((1000 + columns * 2000 / 199 - low) / (high - low), 0, 1) * 255
        assert row == pytest.approx(expected, abs=2)


def test_deep_values_where_the_probes_see_only_nodata(tmp_path):
    values = np.zeros((3, 1600, 1600), np.uint16)
    values[:, :64, :64] = np.linspace(500, 900, 64, dtype=np.uint16)
    write_image(tmp_path / "a.tif", values, nodata=0, compress="deflate", **UTM)
    _, record = tile([tmp_path / "a.tif"], tmp_path / "set")
    assert record.sources[0]["value_range"] == pytest.approx([504, 896], abs=6)
    assert sum(count["tiles"] for count in record.counts.values()) >= 1


@pytest.mark.parametrize("kind", ["nodata", "alpha", "mask"])
def test_empty_ground_yields_no_tile(tmp_path, kind):
    array = noise(200, 200)
    if kind == "nodata":
        array[:, :64, :64] = 0
        # One colour alone may have the value without being empty.
        array[0] = 0
        write_image(tmp_path / "a.tif", array, nodata=0, **UTM)
    elif kind == "alpha":
        alpha = np.full((1, 200, 200), 255, np.uint8)
        alpha[:, :64, :64] = 0
        write_image(
            tmp_path / "a.tif",
            np.concatenate([array, alpha]),
            colours=(RED, GREEN, BLUE, ALPHA),
            **UTM,
        )
    else:
        write_image(tmp_path / "a.tif", array, **UTM)
        mask = np.full((200, 200), 255, np.uint8)
        mask[:64, :64] = 0
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(tmp_path / "a.tif", "r+") as dataset,
        ):
            dataset.write_mask(mask)
    backgrounds, record = tile([tmp_path / "a.tif"], tmp_path / "set")
    assert record.empty == 1
    assert len(all_tiles(backgrounds)) == 8
    assert (0, 0) not in {one.offset_px for one in all_tiles(backgrounds)}


def test_a_few_empty_pixels_take_their_neighbours_colour(tmp_path):
    array = bands(80, 90, 100)
    array[:, 10:15, 10:15] = 0
    write_image(tmp_path / "a.tif", array, nodata=0, **UTM)
    backgrounds, _ = tile([tmp_path / "a.tif"], tmp_path / "set")
    assert {tuple(colour) for one in all_tiles(backgrounds) for colour in
            backgrounds.pixels(one.id).flatten(1).T.tolist()} == {(80, 90, 100)}  # fmt: skip


@pytest.mark.parametrize("nodata", [0, 255])
@pytest.mark.parametrize(("source_gsd_m", "size_px"), [(0.05, 45), (0.125, 90)])
def test_the_edge_of_what_is_empty_looks_as_beside_it(tmp_path, nodata, source_gsd_m, size_px):
    array = bands(80, 90, 100)
    # A straight edge, and a speck in the middle; neither on the grid of the tiles.
    array[:, :, :1] = array[:, 103:106, 91:94] = nodata
    place = UTM | {"transform": from_origin(500_000, 5_300_000, source_gsd_m, source_gsd_m)}
    write_image(tmp_path / "a.tif", array, nodata=nodata, **place)
    # Averaged, and by cubic convolution.
    backgrounds, _ = tile([tmp_path / "a.tif"], tmp_path / "set", gsd_m=0.11, size_px=size_px)
    assert len(all_tiles(backgrounds)) == 4
    colours = {
        tuple(colour)
        for one in all_tiles(backgrounds)
        for colour in backgrounds.pixels(one.id).flatten(1).T.tolist()
    }
    assert colours == {(80, 90, 100)}


@pytest.mark.parametrize(
    ("wrong", "depth"),
    [
        *(
            (one, "float32")
            for one in (np.nan, np.inf, -np.inf, -9999, -3.4028235e38, 3.4028235e38)
        ),
        *((one, "int16") for one in (-9999, -32768)),
    ],
)
def test_what_is_no_number_is_empty(tmp_path, wrong, depth):
    ramp = np.tile(np.linspace(1000, 3000, 200).astype(depth), (200, 1))
    array = np.stack([ramp] * 3)
    # A whole corner, one band of a speck, and nothing that says that it is no data.
    array[:, :64, :64] = wrong
    array[1, 100:102, 100:102] = wrong
    write_image(tmp_path / "a.tif", array, **UTM)
    backgrounds, record = tile([tmp_path / "a.tif"], tmp_path / "set")
    assert any("undeclared fill values" in note for note in record.notes)
    assert record.empty == 1
    assert (0, 0) not in {one.offset_px for one in all_tiles(backgrounds)}
    low, high = record.sources[0]["value_range"]
    for one in all_tiles(backgrounds):
        columns = one.offset_px[0] + np.arange(64)
        expected = np.clip((1000 + columns * 2000 / 199 - low) / (high - low), 0, 1) * 255
        pixels = backgrounds.pixels(one.id).numpy().astype(float)
        assert np.abs(pixels - expected).max() < 4


@pytest.mark.parametrize(
    ("suffix", "world"), [(".jpg", ".jgw"), (".png", ".pgw"), (".png", ".wld"), (".tif", ".tfw")]
)
def test_world_files(tmp_path, suffix, world):
    Image.fromarray(noise(200, 200).transpose(1, 2, 0)).save(tmp_path / f"a{suffix}")
    # A world file gives the middle of the top-left pixel.
    (tmp_path / f"a{world}").write_text("0.125\n0\n0\n-0.125\n1550000.0625\n5189999.9375\n")
    _, record = tile([tmp_path / f"a{suffix}"], tmp_path / "placed", crs="EPSG:2193")
    assert record.sources[0]["crs"] == "EPSG:2193"
    index = (tmp_path / "placed" / "index.geojson").read_text()
    assert "1550000.0" in index
    assert "5190000.0" in index
    _, record = tile([tmp_path / f"a{suffix}"], tmp_path / "own")
    assert record.sources[0]["crs"] is None
    assert record.sources[0]["gsd_m"] == [0.125, 0.125]
    assert "taken as 0.125 x 0.125 m" in record.notes[0]


def test_licence_of_the_file_comes_before_the_users(tmp_path):
    write_image(
        tmp_path / "a.tif", noise(200, 200), tags={"TIFFTAG_COPYRIGHT": "CC BY 4.0 LINZ"}, **UTM
    )
    far = {"crs": "EPSG:32633", "transform": from_origin(510_000, 5_300_000, 0.125, 0.125)}
    write_image(tmp_path / "b.tif", noise(200, 200), **far)
    backgrounds, _ = tile([tmp_path], tmp_path / "set", licence="our own")
    assert {one.source: one.licence for one in all_tiles(backgrounds)} == {
        "a.tif": "CC BY 4.0 LINZ",
        "b.tif": "our own",
    }


def _broken(folder):
    (folder / "x.tif").write_bytes(b"no image at all")


def _truncated(folder):
    path = write_image(folder / "x.tif", noise(200, 200), **UTM)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _truncated_jpeg(folder):
    Image.fromarray(noise(400, 400).transpose(1, 2, 0)).save(folder / "x.jpg", quality=95)
    data = (folder / "x.jpg").read_bytes()
    (folder / "x.jpg").write_bytes(data[: len(data) // 2])


def _picture(folder):
    Image.fromarray(noise(200, 200).transpose(1, 2, 0)).save(folder / "x.png")


def _image(height=200, width=200, **options):
    def make(folder):
        write_image(folder / "x.tif", noise(height, width), **options)

    return make


def _palette(folder):
    Image.fromarray(noise(200, 200, 1)[0]).convert("P").save(folder / "x.png")


def _two_colours(folder):
    Image.fromarray(noise(200, 200, 1)[0] > 128).save(folder / "x.tif", compression="group4")


def _two_values(folder):
    Image.fromarray(noise(200, 200, 1)[0] > 128).save(folder / "x.png")


def _alpha_alone(folder):
    write_image(folder / "x.tif", noise(200, 200, 1), colours=(ALPHA,), **UTM)


def _complex(folder):
    write_image(folder / "x.tif", np.ones((1, 200, 200), np.complex64), **UTM)


def _zero_pixels(folder):
    _picture(folder)
    (folder / "x.png").rename(folder / "y.bin")
    (folder / "x.vrt").write_text(
        '<VRTDataset rasterXSize="200" rasterYSize="200"><SRS>EPSG:2193</SRS>'
        "<GeoTransform>1550000, 0, 0, 5190000, 0, -0.125</GeoTransform>"
        '<VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">y.bin'
        "</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )


def _world_file_in_degrees(folder):
    _picture(folder)
    (folder / "x.pgw").write_text("1e-6\n0\n0\n-1e-6\n172.4\n-43.6\n")


def _hollow(folder):
    write_image(folder / "x.tif", np.zeros((3, 200, 200), np.uint8), nodata=0, **UTM)


def _hollow_deep(folder):
    write_image(folder / "x.tif", np.zeros((3, 200, 200), np.uint16), nodata=0, **UTM)


def _nowhere(folder):
    write_image(
        folder / "x.tif",
        noise(200, 200),
        crs="EPSG:32633",
        transform=from_origin(5e9, 5e9, 0.125, 0.125),
    )


COARSE = {"crs": "EPSG:32633", "transform": from_origin(5e5, 5e6, 0.6, 0.6)}
TURNED = {"crs": "EPSG:32633", "transform": Affine.rotation(45) * Affine.scale(0.6, -0.6)}


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (lambda folder: None, {}, "holds no image"),
        (_broken, {"source_gsd_m": 0.125}, "cannot be read"),
        (_truncated, {}, "cannot be read"),
        (_truncated_jpeg, {"source_gsd_m": 0.125}, "cannot be read"),
        (_image(), {}, "--source.gsd-m"),
        (_picture, {}, "--source.gsd-m"),
        (_image(**COARSE), {}, "0.60 m per pixel"),
        (_image(), {"source_gsd_m": 0.7}, "0.70 m per pixel"),
        (_image(30, 200), {"source_gsd_m": 0.125}, r"25.0 x 3.8 m, .* takes 8.0 m on each side"),
        (_hollow, {}, "No tile of 8.0 m"),
        (_hollow_deep, {}, "holds no valid pixel"),
        (_palette, {"source_gsd_m": 0.125}, "colour palette"),
        (_two_colours, {"source_gsd_m": 0.125}, "holds 1-bit values"),
        (_two_values, {"source_gsd_m": 0.125}, "holds 1-bit values"),
        (_alpha_alone, {}, "alpha band alone"),
        (_complex, {}, "complex values"),
        (_zero_pixels, {}, "pixel size of zero"),
        (_world_file_in_degrees, {}, "give it with --source.crs"),
        (_nowhere, {}, "outside what its reference system covers"),
    ],
)
def test_bad_imagery_is_one_clear_sentence(tmp_path, make, options, message):
    folder = tmp_path / "imagery"
    folder.mkdir()
    make(folder)
    with pytest.raises(ImageryError, match=message) as caught:
        tile([folder], tmp_path / "set", **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "set" / "index.json").exists()


def test_folders_below_are_searched_where_a_folder_holds_no_image(tmp_path):
    folder, elsewhere = tmp_path / "imagery", tmp_path / "elsewhere"
    for place, name in [("b/images", 1), ("a", 2), (".hidden", 3), ("../elsewhere", 4)]:
        (folder / place).mkdir(parents=True)
        write_image(folder / place / f"{name}.tif", noise(20, 20), **UTM)
    (folder / "link").symlink_to(elsewhere)
    assert find_images([folder]) == [folder / "a/2.tif", folder / "b/images/1.tif"]
    sources = inspect_sources([folder / "a", folder / "b"], SourceSettings())
    assert [source.notes for source in sources] == [(), ()]
    sources = inspect_sources([folder], SourceSettings())
    assert sources[0].notes == (f"found in the folder {folder / 'a'}",)
    # Other folders may hold masks or copies.
    (folder / "images/c").mkdir(parents=True)
    write_image(folder / "images/c/5.tif", noise(20, 20), **UTM)
    assert find_images([folder]) == [folder / "images/c/5.tif"]


def test_missing_and_namesake_images_and_bad_settings(tmp_path):
    with pytest.raises(ImageryError, match=r"none\.tif is missing"):
        tile([tmp_path / "none.tif"], tmp_path / "set")
    _image()(tmp_path)
    _picture(tmp_path)
    with pytest.raises(ImageryError, match="shares its name"):
        tile([tmp_path], tmp_path / "set", source_gsd_m=0.125)
    for system in ("EPSG:nonsense", "http://127.0.0.1:9/system", "/etc/hostname"):
        with pytest.raises(ConfigurationError, match=system):
            tile([tmp_path], tmp_path / "set", crs=system)
    for wrong in (
        {"taken": datetime(9999, 12, 31, 23, tzinfo=UTC)},
        {"source_gsd_m": 0.0},
        {"gsd_m": float("nan")},
        {"size_px": 0},
    ):
        with pytest.raises(ConfigurationError, match="expects a"):
            tile([tmp_path / "x.tif"], tmp_path / "set", **wrong)


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_a_png_that_was_cut_off_is_refused_when_it_is_inspected(tmp_path, kept):
    path = tmp_path / "photo.png"
    Image.fromarray(noise(300, 300).transpose(1, 2, 0)).save(path)
    (whole,) = inspect_sources([path], SourceSettings(0.125))
    assert whole.notes == ()
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(ImageryError, match=r"photo\.png cannot be read as an image .* cut off"):
        inspect_sources([path], SourceSettings(0.125))
