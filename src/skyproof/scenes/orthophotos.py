"""Cutting a user's imagery into a background set: true ground resolution, anti-aliased resampling, splits by place."""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
import torch
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.warp import transform as transform_places
from rasterio.windows import Window

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.scenes.backgrounds import SPLITS, BackgroundSet, BackgroundTile, save_tile, write_index

__all__ = ["SPLIT_SHARES", "tile_orthophotos"]

SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg", ".png", ".jp2", ".vrt")
COARSEST_GSD_M = 0.5
EMPTY_MAXIMUM = 0.02
SPLIT_SHARES: Mapping[str, float] = {"train": 0.5, "validation": 0.15, "attack": 0.15, "test": 0.2}

EQUATOR_RADIUS_M, ECCENTRICITY_SQUARED = 6378137.0, 0.00669437999014
"""WGS 84."""


@dataclass(frozen=True)
class _Block:
    """A rectangle of one image, in pixels of the target resolution."""

    path: Path
    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class _Source:
    """An image and its pixel size on the ground, along columns and along rows."""

    path: Path
    gsd_x_m: float
    gsd_y_m: float
    width_px: int
    height_px: int
    licence: str | None


def tile_orthophotos(
    paths: Sequence[Path],
    folder: Path,
    *,
    tile_px: int,
    minimum_tile_px: int,
    generator: torch.Generator,
    gsd_m: float = 0.125,
    assumed_gsd_m: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BackgroundSet:
    """Cuts orthophotos into a background set at one resolution.

    Images are cut into blocks that do not overlap; runs of neighbouring blocks go to one split (PAPER 4), so that
    splits touch only where a run ends, and every large image serves all splits. Blocks with more than 2 % empty
    pixels are left out.

    The images must not show the same ground twice (drone frames that overlap do): that is not checked, and splits would
    then share places.

    Args:
        paths: images, or folders whose images (not those of their sub-folders) are taken.
        folder: where the set goes; use `finished_folder` around it where a half-written folder must not stay.
        tile_px: blocks are about this large; smaller where four would not fit.
        minimum_tile_px: the smallest block allowed: a window turned by any angle must fit.
        generator: shuffles the images.
        gsd_m: metres per pixel of the set.
        assumed_gsd_m: metres per pixel of images that do not say it themselves (the option --gsd).
        progress: called with (blocks done, blocks in all).

    Raises:
        ConfigurationError: `assumed_gsd_m` is not above 0.
        ImageryError: an image that is missing, unreadable, without resolution, coarser than 50 cm or too small; or
            too few blocks for four splits.
        RunFolderError: the disk cannot take it.
    """
    if assumed_gsd_m is not None and not 0 < assumed_gsd_m < math.inf:
        raise ConfigurationError(f"--gsd expects metres per pixel above 0, got {assumed_gsd_m}.")
    files = _files(paths)
    order = torch.randperm(len(files), generator=generator).tolist()
    sources = [_inspect(files[i], assumed_gsd_m) for i in order]
    for source in sources:
        size = min(source.width_px * source.gsd_x_m, source.height_px * source.gsd_y_m) / gsd_m
        if size < minimum_tile_px:
            raise ImageryError(
                f"{source.path} is {int(size)} px wide at {gsd_m} m per pixel but {minimum_tile_px} px are needed; "
                "give larger images or a smaller --sizes.image-px."
            )
    blocks = _enough_blocks(sources, tile_px, minimum_tile_px, gsd_m)
    by_path = {source.path: source for source in sources}
    kept = []
    for done, block in enumerate(blocks):
        tile_id = f"{block.path.stem}-{block.top:05d}-{block.left:05d}"
        image = _read_block(by_path[block.path], block, gsd_m)
        if image is not None:
            tile = BackgroundTile(
                id=tile_id,
                file=f"tiles/{tile_id}.png",
                split="train",
                width_px=block.width,
                height_px=block.height,
                source=block.path.name,
                offset_px=(block.left, block.top),
                licence=by_path[block.path].licence,
            )
            save_tile(folder, tile, torch.from_numpy(image))
            kept.append(tile)
        if progress is not None:
            progress(done + 1, len(blocks))
    write_index(folder, gsd_m, _assign_splits(kept))
    return BackgroundSet.open(folder)


def _files(paths: Sequence[Path]) -> list[Path]:
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
            if not found:
                raise ImageryError(f"{path} holds no image ({', '.join(SUFFIXES)}); give another folder or a file.")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise ImageryError(f"{path} is missing; check --imagery.")
    if not files:
        raise ImageryError("No imagery was given; name images or folders with --imagery.")
    stems = [file.stem for file in files]
    for file in files:
        if stems.count(file.stem) > 1:
            raise ImageryError(f"{file} shares its name with another image; rename one of them.")
    return files


@contextmanager
def _opened(path: Path) -> Iterator[DatasetReader]:
    """Opens an image; every failure of reading becomes one sentence."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as dataset:
                yield dataset
    except (RasterioError, OSError, ValueError) as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise ImageryError(f"{path} cannot be read as an image ({reason}); convert it to GeoTIFF or PNG.") from error


def _inspect(path: Path, assumed_gsd_m: float | None) -> _Source:
    with _opened(path) as dataset:
        ground = _ground_resolution(dataset)
        palette = dataset.colorinterp[0] == ColorInterp.palette
        source_licence = dataset.tags().get("TIFFTAG_COPYRIGHT")
        width, height = dataset.width, dataset.height
    if palette:
        raise ImageryError(f"{path} has a colour palette; convert it to RGB (gdal_translate -expand rgb).")
    if ground is None:
        if assumed_gsd_m is None:
            raise ImageryError(f"{path} does not say how large its pixels are on the ground; give --gsd in metres.")
        ground = assumed_gsd_m, assumed_gsd_m
    if max(ground) > COARSEST_GSD_M:
        raise ImageryError(
            f"{path} has {max(ground):.2f} m per pixel but at most {COARSEST_GSD_M} m can show vehicles; "
            "give finer imagery, or check --gsd."
        )
    return _Source(path, ground[0], ground[1], width, height, source_licence)


def _ground_resolution(dataset: DatasetReader) -> tuple[float, float] | None:
    """Metres on the ground per column and per row, or None without georeference.

    The image's middle and two places beside it are taken to longitude and latitude and measured on the WGS 84
    ellipsoid. This serves every reference system alike: projected metres, feet, degrees, and Web Mercator, whose
    "metres" are too long by 1 / cos(latitude).
    """
    if dataset.crs is None or dataset.transform.is_identity:
        return None
    step = 16.0
    columns = [dataset.width / 2 + shift for shift in (0.0, step, 0.0)]
    rows = [dataset.height / 2 + shift for shift in (0.0, 0.0, step)]
    affine = dataset.transform
    places = [
        (affine.a * column + affine.b * row + affine.c, affine.d * column + affine.e * row + affine.f)
        for column, row in zip(columns, rows, strict=True)
    ]
    longitudes, latitudes = transform_places(dataset.crs, "EPSG:4326", [p[0] for p in places], [p[1] for p in places])
    if not all(map(math.isfinite, [*longitudes, *latitudes])):
        return None
    squeeze = 1 - ECCENTRICITY_SQUARED * math.sin(math.radians(latitudes[0])) ** 2
    east_radius_m = EQUATOR_RADIUS_M / math.sqrt(squeeze) * math.cos(math.radians(latitudes[0]))
    north_radius_m = EQUATOR_RADIUS_M * (1 - ECCENTRICITY_SQUARED) / squeeze**1.5
    distances_m = [
        math.hypot(
            math.radians(longitudes[i] - longitudes[0]) * east_radius_m,
            math.radians(latitudes[i] - latitudes[0]) * north_radius_m,
        )
        for i in (1, 2)
    ]
    return distances_m[0] / step, distances_m[1] / step


def _enough_blocks(sources: list[_Source], tile_px: int, minimum_tile_px: int, gsd_m: float) -> list[_Block]:
    """Blocks of about `tile_px`, or smaller ones until every split can have one."""
    size = max(tile_px, minimum_tile_px)
    while True:
        blocks = [block for source in sources for block in _cut(source, size, minimum_tile_px, gsd_m)]
        if len(blocks) >= len(SPLITS):
            return blocks
        if size == minimum_tile_px:
            raise ImageryError(
                f"The imagery yields {len(blocks)} blocks of {minimum_tile_px} px at {gsd_m} m per pixel but the "
                f"{len(SPLITS)} splits need at least {len(SPLITS)}; give more or larger images, or a smaller "
                "--sizes.image-px."
            )
        size = max(minimum_tile_px, round(size * 0.8))


def _cut(source: _Source, size_px: int, minimum_tile_px: int, gsd_m: float) -> list[_Block]:
    """Divides an image into equal blocks, row by row, back and forth so that neighbours in the list touch."""
    edges = []
    for length_px, ground_m in ((source.width_px, source.gsd_x_m), (source.height_px, source.gsd_y_m)):
        length = math.floor(length_px * ground_m / gsd_m + 1e-6)
        count = max(1, min(round(length / size_px), length // minimum_tile_px))
        edges.append([length * i // count for i in range(count + 1)])
    blocks = []
    for row in range(len(edges[1]) - 1):
        columns = range(len(edges[0]) - 1)
        for column in columns if row % 2 == 0 else reversed(columns):
            left, top = edges[0][column], edges[1][row]
            width, height = edges[0][column + 1] - left, edges[1][row + 1] - top
            blocks.append(_Block(source.path, left, top, width, height))
    return blocks


def _read_block(source: _Source, block: _Block, gsd_m: float) -> NDArray[np.uint8] | None:
    """One block, resampled, `[3, H, W]` bytes; None where it is partly empty."""
    scale_x, scale_y = gsd_m / source.gsd_x_m, gsd_m / source.gsd_y_m
    window = Window(block.left * scale_x, block.top * scale_y, block.width * scale_x, block.height * scale_y)
    # An average over the area when shrinking: point sampling would alias fine structure into coarse patterns.
    method = Resampling.average if max(scale_x, scale_y) > 1 else Resampling.bilinear
    shape = (block.height, block.width)
    with _opened(source.path) as dataset:
        bands = [1, 2, 3] if dataset.count >= 3 else [1, 1, 1]
        valid = dataset.dataset_mask(window=window, out_shape=shape) > 0
        if valid.mean() < 1 - EMPTY_MAXIMUM:
            return None
        pixels = dataset.read(bands, window=window, out_shape=(3, *shape), resampling=method)
        if dataset.dtypes[0] == "uint8":
            return pixels
        low, high = _range(dataset)
    scaled = (pixels.astype(np.float64) - low) / max(high - low, 1e-9)
    return (np.clip(scaled, 0, 1) * 255 + 0.5).astype(np.uint8)


def _range(dataset: DatasetReader) -> tuple[float, float]:
    """The 1st and 99th percentile of an image's valid values, from a coarse view of the whole."""
    shrink = max(1.0, max(dataset.width, dataset.height) / 1024)
    shape = (max(1, int(dataset.height / shrink)), max(1, int(dataset.width / shrink)))
    bands = [1, 2, 3] if dataset.count >= 3 else [1]
    values = dataset.read(bands, out_shape=(len(bands), *shape))
    valid = dataset.dataset_mask(out_shape=shape) > 0
    low, high = np.percentile(values[:, valid], [1, 99])
    return float(low), float(high)


def _assign_splits(tiles: list[BackgroundTile]) -> list[BackgroundTile]:
    """Divides every image among the splits by `SPLIT_SHARES`, in runs of neighbouring tiles; no split stays empty.

    Dividing image by image gives all splits the same kinds of land.
    """
    if len(tiles) < len(SPLITS):
        raise ImageryError(
            f"Only {len(tiles)} blocks of the imagery hold data but the {len(SPLITS)} splits need at least "
            f"{len(SPLITS)}; give more or larger images, or a smaller --sizes.image-px."
        )
    given = dict.fromkeys(SPLITS, 0)
    assigned: list[BackgroundTile] = []
    for _, group in itertools.groupby(tiles, key=lambda tile: tile.source):
        own = list(group)
        runs = dict.fromkeys(SPLITS, 0)
        for _ in own:
            # An empty split first, then the one furthest behind its share.
            split = min(SPLITS, key=lambda name: (given[name] > 0, given[name] / SPLIT_SHARES[name]))
            given[split] += 1
            runs[split] += 1
        names = [split for split in SPLITS for _ in range(runs[split])]
        assigned += [dataclasses.replace(tile, split=name) for tile, name in zip(own, names, strict=True)]
    return assigned
