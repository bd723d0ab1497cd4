"""Opens rasters with GDAL: only known formats, within limits, and no files from elsewhere.

A VRT can name files and addresses, and hold code. Only mosaics of images in its own folder are
read.
"""

import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from pathlib import Path

import rasterio
from affine import Affine
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
from rasterio.io import DatasetReader

from skyproof.errors import ImageryError, SkyproofError
from skyproof.files import refuse_special
from skyproof.pictures import LARGEST_PX, exif_orientation, open_picture

RASTER_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".jp2", ".vrt")
"""Endings of the images that are searched in folders or beside labels."""

LARGEST_RASTER_PX = 10**11
"""About 316,000 x 316,000. Rasters are read window by window: this limits time, not memory."""

_WHOLE_PX = 2**24
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"

_BEGINNINGS = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"\xff\xd8\xff": "JPEG",
    b"\x89PNG": "PNG",
    b"\0\0\0\x0cjP  ": "JP2OpenJPEG",
    b"\xff\x4f\xff\x51": "JP2OpenJPEG",
}
"""First bytes of the known formats. GDAL alone would try hundreds of readers."""

_LARGEST_VRT_BYTES = 64 * 2**20
_DEEPEST_VRT = 4
_ELEMENTS = re.compile(
    "averagedsource|category|categorynames|colorinterp|colortable|complexsource|description|"
    "dstrect|entry|gcp|gcplist|geotransform|hidenodatavalue|maskband|mdi|metadata|nodata|"
    "nodatavalue|offset|scale|simplesource|sourceband|sourcefilename|sourceproperties|srcrect|srs|"
    "unittype|vrtdataset|vrtrasterband",
    re.IGNORECASE,
)
"""What a plain mosaic consists of.

Everything else could name files or addresses, or hold code, as warped, processed and derived kinds
do.
"""
_ATTRIBUTES = re.compile(
    "band|blockxsize|blockysize|c[1-4]|coordinateepoch|dataaxistosrsaxismapping|datatype|domain|"
    "id|info|key|line|pixel|projection|rasterxsize|rasterysize|relativetovrt|resampling|shared|"
    "[xy](off|size)|[xyz]",
    re.IGNORECASE,
)
_DOMAINS = ("", "IMAGE_STRUCTURE", "RPC")
"""Metadata of other domains, such as GEOLOCATION, could name files."""


def open_raster(path: Path) -> DatasetReader:
    """Opens a GeoTIFF, JPEG, PNG, JPEG 2000 or VRT.

    Raises:
        ImageryError: it or its blocks are too large; a VRT holds code or names a file elsewhere.
        RasterioError: it cannot be read.
    """
    path = Path(path)
    refuse_special(path, "give image files", error=ImageryError)
    driver = "VRT" if path.suffix.lower() == ".vrt" else _driver(path)
    if driver == "VRT":
        _check_vrt(path, path.resolve().parent, depth=1)
    with rasterio.Env(GDAL_VRT_ENABLE_PYTHON="NO"), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return _limited(rasterio.open(path, driver=driver), path)


def orientation_of(dataset: DatasetReader, path: Path) -> int:
    """Returns the EXIF orientation of a picture, 1 (upright) to 8.

    GDAL reads pixels as they are stored, and a place on the map refers to these, so the orientation
    counts only for an image without such a place.
    """
    if dataset.driver == "VRT" or not dataset.transform.is_identity or dataset.gcps[0]:
        return 1
    try:
        with open_picture(path, "", error=ImageryError) as picture:
            return exif_orientation(picture)
    except SkyproofError:
        # Bands and depths that only GDAL reads.
        return 1


def is_faster_whole(dataset: DatasetReader) -> bool:
    """Returns whether an image is read faster as a whole than in part or at a smaller size.

    GDAL decodes a whole PNG twice as fast, but then misses that the file was cut off, so that the
    end of the file is checked here.
    """
    if dataset.driver != "PNG" or dataset.width * dataset.height > _WHOLE_PX:
        return False
    with Path(dataset.name).open("rb") as file:
        file.seek(-len(_PNG_END), os.SEEK_END)
        return file.read() == _PNG_END


def stored_to_upright(orientation: int, width_px: int, height_px: int) -> Affine:
    """Returns the transform from stored pixels (column, row) to an upright picture of this size."""
    mirrors_x, mirrors_y = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    across = Affine(-1, 0, width_px, 0, 1, 0) if mirrors_x else Affine.identity()
    down = Affine(1, 0, 0, 0, -1, height_px) if mirrors_y else Affine.identity()
    swaps = Affine(0, 1, 0, 1, 0, 0) if orientation >= 5 else Affine.identity()
    return across * down * swaps


def upright_size_px(dataset: DatasetReader, orientation: int) -> tuple[int, int]:
    """Returns width and height of the upright picture."""
    size = dataset.width, dataset.height
    return size if orientation < 5 else size[::-1]


def _driver(path: Path) -> str:
    with path.open("rb") as file:
        beginning = file.read(16)
    for known, driver in _BEGINNINGS.items():
        if beginning.startswith(known):
            return driver
    raise RasterioIOError("it is neither GeoTIFF, JPEG, PNG nor JPEG 2000")


def _limited(dataset: DatasetReader, path: Path) -> DatasetReader:
    """Closes and refuses a raster that is too large, or keeps overviews elsewhere."""
    with suppress(CPLE_BaseError):
        # GDAL fails when it first reads damaged EXIF data, which can be ignored.
        _ = dataset.colorinterp
    try:
        if dataset.width * dataset.height > LARGEST_RASTER_PX:
            raise ImageryError(
                f"{path} says that it has {dataset.width:,} x {dataset.height:,} px, more than "
                f"{LARGEST_RASTER_PX:,} pixels in all; cut it into parts."
            )
        for rows, columns in dataset.block_shapes:
            if rows * columns > LARGEST_PX:
                raise ImageryError(
                    f"{path} is stored in blocks of {columns:,} x {rows:,} px, more than "
                    f"{LARGEST_PX:,} pixels that have to be read at once; convert it "
                    "(gdal_translate -co TILED=YES)."
                )
        if "OVERVIEW_FILE" in dataset.tags(ns="OVERVIEWS"):
            raise ImageryError(
                f"{path} names a file with overviews, which is not read; convert it "
                "(gdal_translate)."
            )
    except BaseException:
        dataset.close()
        raise
    return dataset


def _check_vrt(path: Path, folder: Path, *, depth: int) -> None:
    """Refuses all but a mosaic of images inside a folder."""
    for element in _elements(path):
        attributes = {name.lower(): value.strip() for name, value in element.attrib.items()}
        strange = [] if _ELEMENTS.fullmatch(element.tag) else [element.tag]
        strange += [name for name in element.attrib if not _ATTRIBUTES.fullmatch(name)]
        if attributes.get("domain", "") not in _DOMAINS:
            strange.append(attributes["domain"])
        if strange:
            raise ImageryError(
                f"{path} holds {strange[0][:200]!r}, and only plain mosaics are read; convert it "
                "to GeoTIFF (gdal_translate)."
            )
        if element.tag.lower() == "sourcefilename":
            reference = (element.text or "").strip()
            relative = attributes.get("relativetovrt", "0")
            # GDAL starts from the folder of the VRT if it says so, else from the working folder.
            base = path.resolve().parent if relative == "1" else Path.cwd()
            source = (base / reference).resolve()
            if not source.is_relative_to(folder):
                raise ImageryError(
                    f"{path} names {reference[:200]}, which is outside its folder and is not "
                    "read; put VRT and images in one folder."
                )
            if not source.is_file():
                raise ImageryError(f"{path} names {reference[:200]}, which is missing; add it.")
            if source.suffix.lower() != ".vrt":
                open_raster(source).close()
                continue
            if depth == _DEEPEST_VRT:
                raise ImageryError(
                    f"{path} is a VRT in more than {_DEEPEST_VRT} others; name its images directly."
                )
            _check_vrt(source, folder, depth=depth + 1)


def _elements(path: Path) -> list[ElementTree.Element]:
    if path.stat().st_size > _LARGEST_VRT_BYTES:
        raise ImageryError(f"{path} is too long for a VRT; name its images directly.")
    try:
        return list(parsed_xml(path.read_text(encoding="utf-8")).iter())
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ImageryError(f"{path} is no VRT ({reason}); name its images directly.") from error


def parsed_xml(text: str) -> ElementTree.Element:
    """Parses untrusted XML; refuses entities, which may grow hugely or name files and addresses.

    Raises:
        ParseError, ValueError: it is no XML, or defines entities.
    """
    # GDAL could parse these differently, too.
    if "<!DOCTYPE" in text.upper() or "<!ENTITY" in text.upper():
        raise ValueError("it defines entities")
    return ElementTree.fromstring(text)
