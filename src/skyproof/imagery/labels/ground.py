"""Reads labels on the ground: points and outlines of GeoJSON, GeoPackage and Shapefile."""

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skyproof.errors import ImageryError
from skyproof.imagery.labels.image_files import LARGEST_NUMBER
from skyproof.imagery.labels.label import GroundLabels, Label, Point, twice_note
from skyproof.imagery.settings import names_a_system

_CLASS_KEYS = ("class", "category", "label", "type")
"""Properties that may name an object's class, in the order of their precedence."""
_UNNAMED = "vehicle"
"""The class of an object without a class name."""
# First bytes of GeoPackages and Shapefiles; everything else is GeoJSON.
_BEGINNINGS = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a"}


def crs_name(path: Path, member: Any) -> str | None:
    """Takes the name from a `crs` member. GDAL would fetch any other kind from its address."""
    if member is None:
        return None
    match member:
        case {"type": "name", "properties": {"name": str(name), **others}} if not others:
            if names_a_system(name):
                return name
    raise _unknown_system(path)


def _unknown_system(path: Path) -> ImageryError:
    return ImageryError(
        f"{path} names no reference system that is known; convert it (ogr2ogr -t_srs EPSG:4326)."
    )


def read_ground_labels(path: Path, system_name: str | None = None) -> GroundLabels:
    """Reads points and outlines of a vector file with one layer.

    The four corners of an outline are kept; any other outline becomes the upright box around it.
    GDAL reads GeoJSON whose `crs` member names an unknown system as WGS 84. A property `ignore`
    that is true marks a region that is not scored.
    """
    # Loaded only for labels on the ground: it takes a second.
    import geopandas

    known = _BEGINNINGS.get(path.suffix.lower())
    if known is not None and not path.read_bytes().startswith(known):
        raise ImageryError(
            f"{path} is no {path.suffix.lower()} file inside; replace it, or name it as it is."
        )
    # GDAL is told which reader to take, because some of them fetch files from elsewhere.
    place = path if known is not None else f"GeoJSON:{path}"
    try:
        layers = geopandas.list_layers(place)
        with warnings.catch_warnings():
            # The errors below name the objects that GDAL warns of.
            warnings.simplefilter("ignore")
            frame = geopandas.read_file(place, layer=0, on_invalid="ignore")
    except Exception as error:  # GDAL, pyogrio, shapely and pyproj each raise their own types
        reason = " ".join(str(error).split())[:200]
        raise ImageryError(f"{path} cannot be read ({reason}); give another file.") from error
    if len(layers) > 1:
        raise ImageryError(f"{path} holds {len(layers)} layers; give a file of one (ogr2ogr).")
    if frame.empty or "geometry" not in frame:
        raise ImageryError(f"{path} holds no objects (features); give another file.")
    crs = None if frame.crs is None else frame.crs.to_string()
    if crs == "EPSG:4326" and system_name is not None:
        crs = crs if re.search("4326|CRS84", system_name) else None
    if crs is None:
        raise _unknown_system(path)
    labels: list[Label] = []
    # Integers stay integers if some objects have none.
    properties = frame.drop(columns="geometry").convert_dtypes()
    records = properties.astype(object).where(properties.notna(), None).to_dict("records")
    for number, (geometry, record) in enumerate(zip(frame.geometry, records, strict=True), 1):
        where = f"{path} object {number}"
        shapes = _shapes(geometry)
        if not shapes:
            raise ImageryError(
                f"{where} is neither a point nor a polygon with coordinates; correct it."
            )
        for corners in shapes:
            if crs == "EPSG:4326" and any(abs(x) > 180 or abs(y) > 90 for x, y in corners):
                raise ImageryError(
                    f"{where} is at {corners[0][0]:g}, {corners[0][1]:g}, which is no longitude "
                    "and latitude; name the reference system in the file, or convert it (ogr2ogr "
                    "-t_srs EPSG:4326)."
                )
            # Shapefiles have no truth values, only numbers.
            ignored = str(record.get("ignore")) in ("True", "1")
            labels.append(Label(_class_name(record, where), corners, ignored))
    single = tuple(dict.fromkeys(labels))
    names = dict.fromkeys(label.class_name for label in single)
    return GroundLabels(tuple(names), single, crs, twice_note(len(labels) - len(single), path))


def _shapes(geometry: Any) -> list[tuple[Point, ...]]:
    """Returns the corners of a geometry's parts; nothing where one is no point or outline."""
    parts = [] if geometry is None else list(getattr(geometry, "geoms", [geometry]))
    shapes = [_corners(part) for part in parts]
    return shapes if all(shapes) else []


def _corners(part: Any) -> tuple[Point, ...]:
    if part.is_empty or not (np.abs(part.bounds) <= LARGEST_NUMBER).all():
        return ()
    if part.geom_type == "Point":
        return ((part.x, part.y),)
    left, bottom, right, top = part.bounds
    if part.geom_type != "Polygon" or left == right or bottom == top:
        return ()
    corners = tuple((x, y) for x, y, *_ in part.exterior.coords[:-1])
    box = ((left, bottom), (right, bottom), (right, top), (left, top))
    return corners if len(corners) == 4 else box


def _class_name(record: Mapping[str, Any], where: str) -> str:
    for key in _CLASS_KEYS:
        value = record.get(key)
        if isinstance(value, list | dict | np.ndarray):
            raise ImageryError(f"{where} has several values as its {key!r}; give one.")
        if value is not None and value != "":
            return str(value)
    return _UNNAMED
