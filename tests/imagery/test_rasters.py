"""Rasters of strangers: known formats, stated limits, and nothing from elsewhere."""

import numpy as np
import pytest
import rasterio
from PIL import Image

from skyproof.errors import ImageryError
from skyproof.imagery import rasters
from skyproof.imagery.rasters import open_raster
from skyproof.imagery.tiles.grid import MOST_CELLS, Grid, cells_of
from skyproof.pictures import LARGEST_PX

from .made import all_tiles, noise, tile, write_image

PLACE = {"crs": "EPSG:2193", "transform": rasterio.Affine(0.125, 0, 1570000, 0, -0.125, 5180000)}


def write_vrt(path, reference, *, band="", source="", relative=1, raster="", size=64):
    """A VRT of one file."""
    path.write_text(
        f"""<VRTDataset rasterXSize="{size}" rasterYSize="{size}"{raster}>
          <SRS>EPSG:2193</SRS>
          <GeoTransform>1570000, 0.125, 0, 5180000, 0, -0.125</GeoTransform>
          <VRTRasterBand dataType="Byte" band="1"{band}>
            <SimpleSource>
              <SourceFilename relativeToVRT="{relative}">{reference}</SourceFilename>
              <SourceBand>1</SourceBand>{source}
              <SrcRect xOff="0" yOff="0" xSize="{size}" ySize="{size}"/>
              <DstRect xOff="0" yOff="0" xSize="{size}" ySize="{size}"/>
            </SimpleSource>
          </VRTRasterBand>
        </VRTDataset>"""
    )
    return path


@pytest.fixture
def folder(tmp_path):
    """A folder of a stranger's with an image, and an image beside it that is not his."""
    (tmp_path / "his").mkdir()
    for place in (tmp_path / "his" / "a.tif", tmp_path / "secret.tif"):
        write_image(place, noise(64, 64), **PLACE)
    return tmp_path / "his"


def test_a_vrt_of_its_own_folder_is_read(folder):
    write_vrt(folder / "inner.vrt", "a.tif")
    write_vrt(folder / "outer.vrt", "inner.vrt")
    for name in ("inner.vrt", "outer.vrt"):
        with open_raster(folder / name) as vrt, open_raster(folder / "a.tif") as own:
            assert np.array_equal(vrt.read(1), own.read(1))


@pytest.mark.parametrize(
    "reference",
    [
        "../secret.tif",
        "link.tif",
        "/vsicurl/http://127.0.0.1:9/a.tif",
        "http://127.0.0.1:9/a.tif",
        "&lt;VRTDataset/&gt;",
        "hidden.vrt",
    ],
)
def test_a_vrt_of_files_elsewhere_is_refused(folder, reference):
    (folder / "link.tif").symlink_to(folder.parent / "secret.tif")
    write_vrt(folder / "hidden.vrt", folder.parent / "secret.tif", relative=0)
    write_vrt(folder / "mosaic.vrt", reference)
    with pytest.raises(ImageryError, match=r"outside its folder|which is missing"):
        open_raster(folder / "mosaic.vrt")


SOURCE = '<SourceFilename relativeToVRT="1">a.tif</SourceFilename>'
WARPED = (
    "<BlockXSize>64</BlockXSize><GDALWarpOptions>"
    '<SourceDataset relativeToVRT="0">{}</SourceDataset>'
    "<Transformer><GenImgProjTransformer><GeoLocTransformer/></GenImgProjTransformer></Transformer>"
    "</GDALWarpOptions>"
)
PROCESSED = (
    "<Input>{}</Input><ProcessingSteps><Step><Algorithm>LocalScaleOffset</Algorithm>"
    '<Argument name="gain_dataset_filename_1">{}</Argument></Step></ProcessingSteps>'
)


def test_names_in_capitals_are_read_as_gdal_reads_them(folder):
    plain = write_vrt(folder / "a.vrt", "a.tif").read_text()
    assert SOURCE in plain
    other = '<SOURCEFILENAME relativetoVRT="1">../secret.tif</SOURCEFILENAME>'
    (folder / "b.vrt").write_text(plain.replace(SOURCE, other))
    with pytest.raises(ImageryError, match="outside its folder"):
        open_raster(folder / "b.vrt")


@pytest.mark.parametrize(
    ("plain", "other", "named"),
    [
        (SOURCE, '<ComplexSource sourcefilename="{}"/>', "sourcefilename"),
        (SOURCE, "<SourceFilename>a.tif<relativeToVRT>1</relativeToVRT></SourceFilename>", "relat"),
        (SOURCE, SOURCE + '<OpenOptions><OOI key="X">{}</OOI></OpenOptions>', "openoptions"),
        ("<SRS>", "<GDALWarpOptions/><SRS>", "gdalwarpoptions"),
        ("<SRS>", WARPED + "<SRS>", "blockxsize"),
        ("<SRS>", PROCESSED + "<SRS>", "input"),
        ("<SRS>", "<Overview><SourceFilename>{}</SourceFilename></Overview><SRS>", "overview"),
        ("<SRS>", '<Metadata domain="GEOLOCATION"/><SRS>', "GEOLOCATION"),
        ("<SRS>", '<Metadata domain="xml:x" format="xml"/><SRS>', "format"),
        ("<VRTDataset", '<VRTDataset subClass="VRTWarpedDataset"', "subclass"),
        ("<VRTDataset", '<VRTDataset SUBCLASS="VRTProcessedDataset"', "subclass"),
        ("<VRTDataset", '<VRTDataset subClass="VRTPansharpenedDataset"', "subclass"),
        ("<VRTDataset", '<VRTDataset xmlns="urn:x"', "vrtdataset"),
    ],
)
def test_all_that_no_mosaic_needs_is_refused(folder, monkeypatch, plain, other, named):
    monkeypatch.chdir(folder)
    text = write_vrt(folder / "a.vrt", "a.tif").read_text()
    secret = str(folder.parent / "secret.tif")
    (folder / "b.vrt").write_text(text.replace(plain, other.replace("{}", secret), 1))
    with pytest.raises(ImageryError, match=rf"(?i)holds '.*{named}.*only plain mosaics are read"):
        open_raster(folder / "b.vrt")


def test_what_gdalbuildvrt_writes_is_read(folder):
    """As version 3.12 writes it for a tiled GeoTIFF with a nodata value."""
    (folder / "m.vrt").write_text(
        """<VRTDataset rasterXSize="64" rasterYSize="64">
          <SRS dataAxisToSRSAxisMapping="2,1">EPSG:2193</SRS>
          <GeoTransform>1.57e6, 0.125, 0, 5.18e6, 0, -0.125</GeoTransform>
          <Metadata domain="IMAGE_STRUCTURE"><MDI key="INTERLEAVE">PIXEL</MDI></Metadata>
          <VRTRasterBand dataType="Byte" band="1" blockXSize="64" blockYSize="64">
            <NoDataValue>0</NoDataValue>
            <ColorInterp>Red</ColorInterp>
            <ComplexSource resampling="nearest">
              <SourceFilename relativeToVRT="1" shared="0">a.tif</SourceFilename>
              <SourceBand>1</SourceBand>
              <SourceProperties RasterXSize="64" RasterYSize="64" DataType="Byte" BlockXSize="64"
                BlockYSize="1"/>
              <SrcRect xOff="0" yOff="0" xSize="64" ySize="64"/>
              <DstRect xOff="0" yOff="0" xSize="64" ySize="64"/>
              <NODATA>0</NODATA>
            </ComplexSource>
          </VRTRasterBand>
        </VRTDataset>"""
    )
    with open_raster(folder / "m.vrt") as vrt, open_raster(folder / "a.tif") as own:
        assert np.array_equal(vrt.read(1), own.read(1))


def test_code_in_a_vrt_is_refused_and_does_not_run(folder):
    band = ' subClass="VRTDerivedRasterBand"'
    code = f"<PixelFunctionCode>open('{folder / 'ran'}', 'w')</PixelFunctionCode>"
    for given in ({"band": band, "source": code}, {"source": code}):
        write_vrt(folder / "a.vrt", "a.tif", **given)
        with pytest.raises(ImageryError, match="only plain mosaics are read"):
            open_raster(folder / "a.vrt")
    assert not (folder / "ran").exists()


def test_entities_in_a_vrt_are_refused(folder):
    text = write_vrt(folder / "a.vrt", "&f;").read_text()
    (folder / "a.vrt").write_text('<!DOCTYPE x [<!ENTITY f "../secret.tif">]>' + text)
    with pytest.raises(ImageryError, match="defines entities"):
        open_raster(folder / "a.vrt")


def test_what_its_name_does_not_say_is_not_tried(folder, tmp_path):
    write_vrt(folder / "a.png", "../secret.tif")
    (folder / "b.tif").write_text("<GDAL_WMS><Service name='TMS'/></GDAL_WMS>")
    Image.new("RGB", (64, 64)).save(folder / "c.tif", format="BMP")
    for name in ("a.png", "b.tif", "c.tif"):
        with pytest.raises(ImageryError, match=r"neither GeoTIFF, JPEG, PNG nor JPEG 2000"):
            tile([folder / name], tmp_path / "set", source_gsd_m=0.125)
        (folder / "v.vrt").unlink(missing_ok=True)
        write_vrt(folder / "v.vrt", name)
        with pytest.raises(ImageryError, match=r"neither GeoTIFF, JPEG, PNG nor JPEG 2000"):
            tile([folder / "v.vrt"], tmp_path / "set")


def sparse(path, side, **options):
    """A GeoTIFF of which only one corner is on the disk."""
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=3, dtype="uint8", nodata=0,
        SPARSE_OK=True, BIGTIFF="YES", **(PLACE | {"tiled": True} | options),
    ) as file:  # fmt: skip
        file.write(noise(1024, 1024), window=rasterio.windows.Window(0, 0, 1024, 1024))
    return path


def test_a_header_that_claims_too_much_is_one_sentence(tmp_path):
    vast = sparse(tmp_path / "vast.tif", 10**6, blockxsize=4096, blockysize=4096)
    with pytest.raises(ImageryError, match=r"1,000,000 x 1,000,000 px, more than 100,000,000,000"):
        tile([vast], tmp_path / "set")


def test_blocks_that_are_read_at_once_have_a_limit(tmp_path, monkeypatch):
    path = write_image(tmp_path / "a.tif", noise(64, 64), blockysize=64, compress="deflate")
    monkeypatch.setattr(rasters, "LARGEST_PX", 64 * 64)
    open_raster(path).close()
    monkeypatch.setattr(rasters, "LARGEST_PX", 64 * 64 - 1)
    with pytest.raises(ImageryError, match=r"blocks of 64 x 64 px"):
        open_raster(path)


def test_more_cells_than_anybody_wants_are_one_sentence():
    side_m = 64 * 0.125
    extent = (0.0, -side_m * 1000, side_m * 1000, 0.0)
    grid = Grid("grid", None, 0.0, 0.0, 64, 0.125, {0: extent})
    assert MOST_CELLS < 1000**2
    with pytest.raises(ImageryError, match=r"grid grid would become 1,00\d,\d+ tiles of 64 px"):
        cells_of(grid)


def test_a_large_mosaic_is_read_window_by_window(tmp_path):
    # 196 megapixels, more than are ever decoded at once.
    assert LARGEST_PX < 14_000**2
    backgrounds, record = tile([sparse(tmp_path / "a.tif", 14_000)], tmp_path / "set", size_px=256)
    assert len(all_tiles(backgrounds)) >= 9
    assert record.empty > 2000
