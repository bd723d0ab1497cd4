"""Reads labels in map coordinates: points or outlines in GeoJSON, GeoPackage or Shapefile."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import GroundLabels, Label, Point
from skyproof.imagery.labels.text import LARGEST_NUMBER

CLASS_KEYS = ("class", "category", "label", "type")
"""Properties that may say an object's class; the first that is there counts."""
# How GeoPackages and Shapefiles begin; everything else is GeoJSON.
_BEGINNINGS = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a"}

UNNAMED = "vehicle"
"""The class of an object that says none."""


def read_ground_labels(path: Path, crs_member: Any = None) -> GroundLabels:
    """Takes points and outlines from a vector file of one layer.

    Of an outline of four corners these are kept, of any other the upright box around it. GeoJSON
    coordinates are longitude and latitude (WGS 84), unless a `crs` member, which GeoJSON had until
    2016 and GDAL still writes, names another system. A property `ignore` that is true marks a
    region where nothing is to be scored.

    Args:
        crs_member: what a GeoJSON document says about its system: GDAL takes one that it does not
            know for WGS 84.

    Raises:
        ImageryError: the file cannot be read, has several layers, no objects, one that is neither
            point nor outline, no known reference system, or coordinates that are no longitudes and
            latitudes though no other system is named.
    """
    # Loaded only where labels lie on the ground: it takes a second.
    import geopandas

    known = _BEGINNINGS.get(path.suffix.lower())
    if known is not None and not path.read_bytes()[: len(known)] == known:
        raise ImageryError(
            f"{path} is no {path.suffix.lower()} file inside; replace it, or name it as it is."
        )
    # GDAL is told which reader to take: others of them fetch from elsewhere.
    place = path if known is not None else f"GeoJSON:{path}"
    try:
        layers = geopandas.list_layers(place)
        with warnings.catch_warnings():
            # What GDAL complains of here is said below, by object.
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
    if crs == "EPSG:4326" and crs_member is not None:
        crs = crs if re.search("4326|CRS84", str(crs_member)) else None
    if crs is None:
        raise ImageryError(
            f"{path} names no reference system that is known; convert it (ogr2ogr -t_srs "
            "EPSG:4326)."
        )
    labels: list[Label] = []
    # So that numbers stay whole where some objects have none.
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
            labels.append(Label(_class_name(record), corners, _ignored(record)))
    names = dict.fromkeys(label.class_name for label in labels)
    return GroundLabels(tuple(names), tuple(labels), crs)


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


def _class_name(record: Mapping[str, Any]) -> str:
    values = [record[key] for key in CLASS_KEYS if record.get(key) not in (None, "")]
    return str(values[0]) if values else UNNAMED


def _ignored(record: Mapping[str, Any]) -> bool:
    # Shapefiles have no truth values, only numbers.
    return str(record.get("ignore")) in ("True", "1")
