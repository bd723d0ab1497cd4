"""Inspects orthophotos: their bands, the range of their values, their place."""

import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from skyproof.errors import ImageryError
from skyproof.imagery.exif import Exif, read_exif
from skyproof.imagery.labels.image_files import IMAGE_FOLDERS
from skyproof.imagery.notes import ImageNote
from skyproof.imagery.rasters import (
    RASTER_SUFFIXES,
    open_raster,
    orientation_of,
    stored_to_upright,
    upright_size_px,
)
from skyproof.imagery.settings import SourceSettings
from skyproof.imagery.tiles.collars import Collar, corners_of, find_collars, is_lossy
from skyproof.imagery.tiles.georeference import Georeference, read_georeference

GDAL_CACHE_MB = 256
OPEN_AT_ONCE = 8

_PROBES, _PROBE_PX = 12, 128
_BELOW_ALL, _ABOVE_ALL = -9000.0, 1e30
"""Picture values lie between the usual fill values (-9999, -32768, -3.4e38, 3.4e38, NaN)."""
_DOUBTED = 1.6
"""Factor by which heights above the take-off point are seldom off."""
_COLOURS = ("red", "green", "blue")
_INFRARED = ("nir", "rededge", "swir", "mwir", "lwir")


@dataclass(frozen=True)
class Source:
    """An orthophoto that was inspected but not read; `notes` state assumptions and repairs.

    Attributes:
        width_px: its upright width; `height_px`, georeference and labels are upright, too.
        stored: transform from stored pixels (column, row) to those of the upright image.
        bands: the bands, from 1, taken as red, green and blue.
        value_range: the values that become black and white; None if bytes are taken as they are.
        alpha_is_colour: whether its alpha band is no mask.
        collars: its empty surroundings that it does not declare, in stored pixels.
    """

    path: Path
    width_px: int
    height_px: int
    stored: Affine
    georeference: Georeference
    bands: tuple[int, int, int]
    value_range: tuple[float, float] | None
    alpha_is_colour: bool
    nodata: float | None
    licence: str | None
    exif: Exif
    notes: tuple[str, ...]
    collars: tuple[Collar, ...] = ()

    @property
    def smaller_side_m(self) -> float:
        across_m, down_m = self.georeference.gsd_m
        return min(self.width_px * across_m, self.height_px * down_m)


def find_images(paths: Sequence[Path]) -> list[Path]:
    """Lists the images among `paths` and in folders among them: directly, in `images/` or in
    `JPEGImages/`, or else in any folder below, as in sets of training data.

    Raises:
        ImageryError: a path is missing, a folder holds no image, or two images share a name.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            folder, *usual = _places(path)
            near, below = map(_images_in, (folder, *usual)), map(_images_below, (*usual, folder))
            images = next(filter(None, chain(near, below)), [])
            if not images:
                raise ImageryError(
                    f"{path} holds no image ({', '.join(RASTER_SUFFIXES)}); give the folder of the "
                    "images, or a file."
                )
            files += images
        elif path.is_file():
            files.append(path)
        else:
            raise ImageryError(f"{path} is missing; check the paths of the imagery.")
    if not files:
        raise ImageryError("No imagery was given; name images or folders of them.")
    seen: dict[str, Path] = {}
    for file in files:
        other = seen.setdefault(file.stem, file)
        if other is not file:
            raise ImageryError(
                f"{file} shares its name with another image, {other}, and labels and tiles go by "
                "these names; rename one of them, or leave it out."
            )
    return files


def _places(path: Path) -> list[Path]:
    return [path, *(path / name for name in IMAGE_FOLDERS)]


def _images_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    # Other systems leave hidden files beside images: ._photo.jpg.
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in RASTER_SUFFIXES and not file.name.startswith(".")
    )


def _images_below(folder: Path) -> list[Path]:
    """Lists the images in the folders below; links to folders and hidden folders are left out."""
    images: list[Path] = []
    for parent, folders, _ in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        images += _images_in(Path(parent))
    return images


class SourceReader:
    """Opens images when they are needed and keeps a few of them open until the block ends.

    GDAL gets a small block cache, and damaged JPEGs are an error instead of grey areas.
    """

    def __init__(self) -> None:
        self._open: OrderedDict[Path, DatasetReader] = OrderedDict()
        self._limits = rasterio.Env(
            GDAL_CACHEMAX=GDAL_CACHE_MB, GDAL_ERROR_ON_LIBJPEG_WARNING=True, GDAL_NUM_THREADS="1"
        )

    def __enter__(self) -> "SourceReader":
        self._limits.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        while self._open:
            self._open.popitem()[1].close()
        self._limits.__exit__()

    @contextmanager
    def reading(self, path: Path) -> Iterator[DatasetReader]:
        """Yields the opened image; a failure while it is read becomes an ImageryError."""
        try:
            if path not in self._open:
                self._open[path] = open_raster(path)
            self._open.move_to_end(path)
            while len(self._open) > OPEN_AT_ONCE:
                self._open.popitem(last=False)[1].close()
            yield self._open[path]
        except (RasterioError, CPLE_BaseError, OSError, ValueError) as error:
            reason = " ".join(str(error.__cause__ or error).split())
            raise ImageryError(
                f"{path} cannot be read as an image ({reason}); it may be cut off: fetch it again, "
                "or convert it to GeoTIFF or PNG."
            ) from error


def inspect_source(path: Path, settings: SourceSettings, reader: SourceReader) -> Source:
    """Finds out how to read an image."""
    with reader.reading(path) as dataset:
        if dataset.count == 0:
            raise ImageryError(
                f"{path} holds several images or none; name one of its images in a .vrt file."
            )
        bits = int(dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8))
        if bits < 8:
            raise ImageryError(
                f"{path} holds {bits}-bit values but at least 8 bits show vehicles; give the "
                "imagery that it was made from."
            )
        if ColorInterp.palette in dataset.colorinterp:
            raise ImageryError(
                f"{path} has a colour palette; convert it to RGB (gdal_translate -expand rgb)."
            )
        if any(kind.startswith("complex") for kind in dataset.dtypes):
            raise ImageryError(f"{path} has complex values; give imagery with 8 or 16 bits a band.")
        notes: list[str] = []
        bands = _choose_bands(dataset, notes)
        alpha_is_colour = _alpha_is_colour(dataset, notes)
        orientation = orientation_of(dataset, path)
        if orientation > 1:
            notes.append("turned as its EXIF orientation says, and labels are taken as made on it")
        size_px = upright_size_px(dataset, orientation)
        source = Source(
            path=path,
            width_px=size_px[0],
            height_px=size_px[1],
            stored=stored_to_upright(orientation, *size_px),
            georeference=read_georeference(dataset, path, settings, notes),
            bands=bands,
            value_range=None,
            alpha_is_colour=alpha_is_colour,
            nodata=dataset.nodata,
            licence=dataset.tags().get("TIFFTAG_COPYRIGHT") or settings.licence,
            notes=tuple(notes),
            exif=read_exif(dataset),
        )
        notes += _doubts(source)
        collars = find_collars(dataset, sorted({*bands}), _unmasked_corners(dataset, source))
        notes += [f"its {one.colour} collar is left out" for one in collars]
        source = replace(source, collars=collars, notes=tuple(notes))
        kinds = [dataset.dtypes[band - 1] for band in bands]
        if {*kinds} == {"uint8"}:
            return source
        low, high = _value_range(dataset, source, notes)
    notes.append(f"{kinds[0]} values from {low:.6g} to {high:.6g} become 0 to 255")
    return replace(source, value_range=(low, high), notes=tuple(notes))


def _doubts(source: Source) -> list[str]:
    """Returns a note if the resolution given is far from that suggested by the camera's height."""
    likely_m, (gsd_m, _) = source.exif.gsd_m, source.georeference.gsd_m
    given = source.georeference.crs is None
    if not given or likely_m is None or 1 / _DOUBTED < gsd_m / likely_m < _DOUBTED:
        return []
    return [
        f"its camera's height suggests about {100 * likely_m:.1f} rather than {100 * gsd_m:.1f} cm "
        "per pixel; check the metres per pixel given"
    ]


def _unmasked_corners(dataset: DatasetReader, source: Source) -> list[Window]:
    """Lists the corners of an image where its mask or nodata value leaves a collar in sight."""
    flags = dataset.mask_flag_enums[source.bands[0] - 1]
    if MaskFlags.nodata in flags and is_lossy(dataset):
        # A few pixels of the collar have the value, and the others miss it by a little.
        return [*corners_of(dataset)]
    return [at for at in corners_of(dataset) if read_mask(dataset, source, at).any()]


def inspect_sources(paths: Sequence[Path], settings: SourceSettings) -> list[Source]:
    """Finds out how to read the images among `paths`; see `find_images` and `inspect_source`."""
    given = {place for path in map(Path, paths) for place in _places(path)}
    with SourceReader() as reader:
        sources = [inspect_source(path, settings, reader) for path in find_images(paths)]
    return [
        source
        if {source.path, source.path.parent} & given
        else replace(source, notes=(*source.notes, f"found in the folder {source.path.parent}"))
        for source in sources
    ]


def notes_on(sources: Sequence[Source]) -> list[str]:
    """The notes on images, each with the name of its image."""
    return [ImageNote(source.path.name, note) for source in sources for note in source.notes]


def _choose_bands(dataset: DatasetReader, notes: list[str]) -> tuple[int, int, int]:
    """Chooses red, green and blue by colour interpretation, then by name, else the first three."""
    kinds = [kind.name for kind in dataset.colorinterp]
    names = [(name or "").strip().lower() for name in dataset.descriptions]
    for tags in (kinds, names):
        if all(colour in tags for colour in _COLOURS):
            red, green, blue = (tags.index(colour) + 1 for colour in _COLOURS)
            others = [kind for band, kind in enumerate(kinds, 1) if band not in (red, green, blue)]
            if any(kind != "alpha" for kind in others):
                notes.append(
                    f"of {dataset.count} bands red, green and blue are taken ({red}, {green}, "
                    f"{blue})"
                )
            return red, green, blue
    colours = [band for band, kind in enumerate(kinds, 1) if kind != "alpha"]
    if not colours:
        raise ImageryError(f"{dataset.name} holds an alpha band alone; give imagery with colours.")
    if len(colours) < 3:
        if len(colours) == 2:
            notes.append(
                f"two bands without red, green and blue: band {colours[0]} is taken as grey"
            )
        return colours[0], colours[0], colours[0]
    infrared = [band for band, kind in enumerate(kinds, 1) if kind in _INFRARED]
    why = "it does not say which are colours"
    if infrared:
        why = f"its band {infrared[0]} is infrared and it has no blue"
    notes.append(
        f"of {dataset.count} bands the bands {colours[0]}, {colours[1]}, {colours[2]} are shown as "
        f"red, green and blue, because {why}"
    )
    return colours[0], colours[1], colours[2]


def _alpha_is_colour(dataset: DatasetReader, notes: list[str]) -> bool:
    """Returns whether a band tagged as alpha holds a picture; some writers tag infrared so."""
    if ColorInterp.alpha not in dataset.colorinterp:
        return False
    band = dataset.colorinterp.index(ColorInterp.alpha) + 1
    values = np.concatenate([dataset.read(band, window=at).ravel() for at in _probes(dataset)])
    full = np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1
    if np.mean((values != 0) & (values != full) & (values != 255)) < 0.5:
        return False
    notes.append(f"band {band} is tagged as alpha but holds a picture (infrared?); it is left out")
    return True


def _probes(dataset: DatasetReader) -> Iterator[Window]:
    """Spreads small windows evenly: a shrunken view would read a mosaic without overviews whole."""
    if dataset.width * dataset.height <= (_PROBES * _PROBE_PX) ** 2:
        yield Window(0, 0, dataset.width, dataset.height)
        return
    shares = [(i + 0.5) / _PROBES for i in range(_PROBES)]
    columns, rows = (
        sorted({min(max(0, length - _PROBE_PX), int(length * share)) for share in shares})
        for length in (dataset.width, dataset.height)
    )
    size_px = min(_PROBE_PX, dataset.width), min(_PROBE_PX, dataset.height)
    yield from (Window(column, row, *size_px) for row in rows for column in columns)


def _value_range(dataset: DatasetReader, source: Source, notes: list[str]) -> tuple[float, float]:
    """Returns the 1st and 99th percentile of an image's valid values, all colours together."""
    bands = sorted({*source.bands})
    samples = []
    empty = False
    whole = Window(0, 0, dataset.width, dataset.height)
    shrunken = min(dataset.height, 2048), min(dataset.width, 2048)
    # If all probes fall on empty ground, which is rare, the whole image has to be read.
    for windows, shape in ((_probes(dataset), None), (iter([whole]), shrunken)):
        for window in windows:
            size = shape or (int(window.height), int(window.width))
            values = dataset.read(bands, window=window, out_shape=(len(bands), *size))
            values = values.astype(np.float32)
            valid = read_mask(dataset, source, window, size) > 0
            numbers = holds_data(values)
            empty |= bool((valid & ~numbers).any())
            samples.append(values[:, valid & numbers].ravel())
        if any(len(values) for values in samples):
            if empty:
                notes.append("its undeclared fill values (such as NaN or -9999) hold no data")
            low, high = np.percentile(np.concatenate(samples), [1, 99])
            return float(low), max(float(high), float(low) + 1e-6)
    raise ImageryError(f"{source.path} holds no valid pixel; leave it out.")


def holds_data(values: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns which pixels of `[bands, H, W]` hold values of a picture rather than fill values."""
    return np.logical_and.reduce(np.logical_and(values > _BELOW_ALL, values < _ABOVE_ALL), axis=0)


def read_mask(
    dataset: DatasetReader, source: Source, window: Window, shape: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """Reads 255 for pixels with data in `window`, else 0: alpha, mask, nodata value, collars."""
    shape = shape or (int(window.height), int(window.width))
    mask = _declared_mask(dataset, source, window, shape)
    for collar in source.collars:
        mask[collar.covers(window, shape)] = 0
    return mask


def _declared_mask(
    dataset: DatasetReader, source: Source, window: Window, shape: tuple[int, int]
) -> NDArray[np.uint8]:
    colours = sorted({*source.bands})
    flags = [*dataset.mask_flag_enums[source.bands[0] - 1]]
    if flags == [MaskFlags.all_valid] or (source.alpha_is_colour and MaskFlags.nodata not in flags):
        return np.full(shape, 255, np.uint8)
    if source.alpha_is_colour or MaskFlags.nodata in flags:
        # A pixel is empty if every colour is: one colour alone may well have the value.
        return dataset.read_masks(colours, window=window, out_shape=(len(colours), *shape)).max(0)
    return dataset.dataset_mask(window=window, out_shape=shape)
