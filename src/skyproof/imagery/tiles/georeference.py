"""The place and resolution of an image in any reference system."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from affine import Affine
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.errors import CRSError, RasterioError
from rasterio.io import DatasetReader
from rasterio.transform import from_gcps
from rasterio.warp import transform as transform_places

from skyproof.errors import ImageryError
from skyproof.imagery.exif import read_exif
from skyproof.imagery.settings import SourceSettings, names_a_system

COARSEST_GSD_M = 0.5
FINEST_PLAUSIBLE_M = 0.005
_FINEST_COMMON_M = 0.01
_SAME_GSD = 0.01
TRUE_TO_SCALE = 0.0015

_LARGEST_OFFSET_PX = 1.0
"""Largest distance of control points from an affine transform that may replace them."""

EQUATOR_RADIUS_M, ECCENTRICITY_SQUARED = 6378137.0, 0.00669437999014
"""WGS 84."""

Point = tuple[float, float]

DEGREES = CRS.from_epsg(4326)


@dataclass(frozen=True)
class Georeference:
    """The place of an image: pixels (column, row) to coordinates, and metres per column and row.

    Without a system it has a grid of its own, x right and y up from its top-left corner, in metres,
    or lies in the `plane` of all images that show the same ground.
    """

    crs: CRS | None
    transform: Affine
    gsd_m: tuple[float, float]
    plane: str | None = None


def to_reference_system(
    source: CRS | None, target: CRS | None, points: Sequence[Point]
) -> list[Point]:
    """Takes points from one system to another; points without a place there become infinite."""
    if source == target or not points:
        return list(points)
    try:
        xs, ys, *_ = transform_places(source, target, *zip(*points, strict=True))
        return list(zip(xs, ys, strict=True))
    except (RasterioError, CPLE_BaseError):
        # One bad point makes all fail, so halves are tried until it stands alone.
        if len(points) == 1:
            return [(math.inf, math.inf)]
        half = len(points) // 2
        parts = points[:half], points[half:]
        return [point for part in parts for point in to_reference_system(source, target, part)]


def outline(width_px: int, height_px: int, steps: int = 8) -> list[Point]:
    """Returns points along a picture's border: lines in one system are curves in another."""
    width, height = float(width_px), float(height_px)
    shares = [i / steps for i in range(steps)]
    half = [(share * width, 0.0) for share in shares]
    half += [(width, share * height) for share in shares]
    return [*half, *((width - x, height - y) for x, y in half)]


def read_georeference(
    dataset: DatasetReader, path: Path, settings: SourceSettings, notes: list[str]
) -> Georeference:
    """Finds the place of an image, and adds assumptions to `notes`.

    The system that is given is that of a transform (the file's or a world file's) that names none,
    or a local one, which lies nowhere on Earth. Without any system an image has the metres per
    pixel that are given, or the transform's pixel size if plausible, in the local system's unit or
    in metres.
    """
    source_gsd_m, crs = settings.gsd_m, settings.crs
    affine, system = dataset.transform, dataset.crs
    if affine.is_identity:
        affine, system = _by_control_points(dataset, path, source_gsd_m, notes)
    plain = affine.is_identity
    local = system is not None and not (system.is_geographic or system.is_projected)
    if not plain and abs(affine.determinant) < 1e-30:
        raise ImageryError(
            f"{path} has a pixel size of zero in its georeference; repair it (gdal_edit.py "
            "-a_ullr), or remove it and give its metres per pixel (--source.gsd-m)."
        )
    if not plain and (system is None or local) and crs is not None:
        local, system = False, CRS.from_user_input(crs)
        notes.append(f"its reference system is taken as {crs}")
    if not plain and system is not None and not local:
        x, y, step = dataset.width / 2, dataset.height / 2, 16.0
        corner = [affine * place for place in ((x, y), (x + step, y), (x, y + step))]
        lengths_m = distances_m(system, corner)
        if lengths_m is None:
            raise ImageryError(
                f"{path} lies outside what its reference system covers; check its system (or "
                "--source.crs)."
            )
        gsd_m = lengths_m[0] / step, lengths_m[1] / step
        _check_resolution(path, gsd_m, "the image", notes)
        if source_gsd_m is not None and abs(math.log(gsd_m[0] / source_gsd_m)) > _SAME_GSD:
            notes.append(
                f"it states {gsd_m[0]:.4g} m per pixel itself, and the {source_gsd_m:g} m given do "
                "not count"
            )
        return Georeference(system, affine, gsd_m)
    if source_gsd_m is not None:
        gsd_m = source_gsd_m, source_gsd_m
        if local:
            notes.append("it names only a local reference system: its pixels are taken as given")
    elif plain:
        likely_m = read_exif(dataset).gsd_m
        hint = "" if likely_m is None else f", by its camera's height about {likely_m:.2g}"
        raise ImageryError(
            f"{path} does not say how large its pixels are on the ground; give its metres per "
            f"pixel (--source.gsd-m{hint})."
        )
    else:
        # A local system may say that its unit is unknown, with a length of zero.
        unit_m = system.units_factor[1] or 1.0 if system is not None else 1.0
        gsd_m = unit_m * math.hypot(affine.a, affine.d), unit_m * math.hypot(affine.b, affine.e)
        which = "names only a local reference system" if local else "names no reference system"
        if not all(FINEST_PLAUSIBLE_M <= size <= COARSEST_GSD_M for size in gsd_m):
            raise ImageryError(
                f"{path} has pixels of {gsd_m[0]:.6g} x {gsd_m[1]:.6g} but {which}; give it with "
                "--source.crs, or the metres per pixel with --source.gsd-m."
            )
        notes.append(f"it {which}: its pixels are taken as {gsd_m[0]:.4g} x {gsd_m[1]:.4g} m")
    _check_resolution(path, gsd_m, "the metres per pixel given", notes)
    return Georeference(None, Affine.scale(gsd_m[0], -gsd_m[1]), gsd_m)


def _by_control_points(
    dataset: DatasetReader, path: Path, source_gsd_m: float | None, notes: list[str]
) -> tuple[Affine, CRS | None]:
    """Returns transform and system of an image that has no transform: identity if nothing fits.

    Control points count if one affine transform fits them. Everything else would bend the image,
    which is left to GDAL's own tool.
    """
    points, system = dataset.gcps
    options = "-r cubic -dstalpha"
    if points:
        affine = from_gcps(points)
        if abs(affine.determinant) > 1e-30:
            offsets_px = [math.dist(~affine * (one.x, one.y), (one.col, one.row)) for one in points]
            if max(offsets_px) <= _LARGEST_OFFSET_PX:
                notes.append(f"placed by its {len(points)} ground control points")
                return affine, system
        means = "ground control points"
    elif dataset.rpcs is not None:
        means, options = "RPCs", f"-rpc -to RPC_DEM=heights.tif {options}"
    else:
        return dataset.transform, dataset.crs
    if source_gsd_m is None:
        raise ImageryError(
            f"{path} is placed by {means} alone, which bend it; warp it (gdalwarp {options} "
            f"{path.name} warped.tif), or give its metres per pixel (--source.gsd-m)."
        )
    notes.append(f"its {means} are left out, because its metres per pixel are given")
    return dataset.transform, None


def _check_resolution(path: Path, gsd_m: tuple[float, float], whose: str, notes: list[str]) -> None:
    if min(gsd_m) < _FINEST_COMMON_M:
        notes.append(
            f"{100 * min(gsd_m):.2g} cm per pixel is finer than nearly all imagery; check {whose}"
        )
    if max(gsd_m) > COARSEST_GSD_M:
        raise ImageryError(
            f"{path} has {max(gsd_m):.2f} m per pixel but at most {COARSEST_GSD_M} m can show "
            f"vehicles; give finer imagery, or check {whose}."
        )


def distances_m(crs: CRS, places: Sequence[Point]) -> list[float] | None:
    """Returns distances of nearby places from the first; None if one is nowhere on Earth."""
    degrees = to_reference_system(crs, DEGREES, places)
    if not all(math.isfinite(value) for place in degrees for value in place):
        return None
    longitude, latitude = degrees[0]
    squeeze = 1 - ECCENTRICITY_SQUARED * math.sin(math.radians(latitude)) ** 2
    east_radius_m = EQUATOR_RADIUS_M / math.sqrt(squeeze) * math.cos(math.radians(latitude))
    north_radius_m = EQUATOR_RADIUS_M * (1 - ECCENTRICITY_SQUARED) / squeeze**1.5
    return [
        math.hypot(
            math.radians(x - longitude) * east_radius_m, math.radians(y - latitude) * north_radius_m
        )
        for x, y in degrees[1:]
    ]


def is_true_to_scale(crs: CRS, place: Point) -> bool:
    """Returns whether a unit is a metre to within 0.15 %, as in UTM and most national grids."""
    (x, y), step = place, 100.0
    lengths_m = distances_m(crs, [place, (x + step, y), (x, y + step)]) or [math.inf]
    return crs.is_projected and all(abs(one / step - 1) < TRUE_TO_SCALE for one in lengths_m)


def system_of(name: str, path: object) -> CRS:
    try:
        if not names_a_system(name):
            raise CRSError("an address or a path")
        return CRS.from_user_input(name)
    except CRSError as error:
        raise ImageryError(
            f"{path} has a reference system that is not known here ({name[:100]}); convert it "
            "(ogr2ogr -t_srs EPSG:4326)."
        ) from error
