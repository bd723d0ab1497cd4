"""GeoJSON labels: points or outlines of vehicles in map coordinates."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import GroundLabels, Label, Point

__all__ = ["CLASS_KEYS", "UNNAMED", "parse_geojson_labels"]

CLASS_KEYS = ("class", "category", "label", "type")
"""Properties that may say an object's class; the first that is there counts."""
UNNAMED = "vehicle"
"""The class of an object that says none."""


def parse_geojson_labels(document: Mapping[str, Any], path: Path) -> GroundLabels:
    """Takes points and outlines from a FeatureCollection.

    Of an outline of four corners these are kept, of any other the upright box around it. Coordinates are longitude and
    latitude (WGS 84), unless a `crs` member, which GeoJSON had until 2016 and GDAL still writes, names another system.
    A property `ignore: true` marks a region where nothing is to be scored.

    Args:
        document: of the file.
        path: the file, for messages.

    Raises:
        ImageryError: no objects, one that is neither point nor outline, an unknown reference system, or coordinates
            that are no longitudes and latitudes though no other system is named.
    """
    crs, labels = _crs(document, path), []
    features = document.get("features")
    if not isinstance(features, list) or not features:
        raise ImageryError(f"{path} holds no objects (features); give another file.")
    for number, feature in enumerate(features, 1):
        where = f"{path} object {number}"
        try:
            properties = feature.get("properties") or {}
            named = [properties[key] for key in CLASS_KEYS if properties.get(key) not in (None, "")]
            shapes = _shapes(feature["geometry"])
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise ImageryError(
                f"{where} is neither a point nor a polygon with coordinates; correct it."
            ) from error
        name, ignore = str(named[0]) if named else UNNAMED, properties.get("ignore") is True
        for corners in shapes:
            if crs == "EPSG:4326" and any(abs(x) > 180 or abs(y) > 90 for x, y in corners):
                raise ImageryError(
                    f"{where} is at {corners[0][0]:g}, {corners[0][1]:g}, which is no longitude and latitude; name the "
                    "reference system in a crs member, or convert the file (ogr2ogr -t_srs EPSG:4326)."
                )
            labels.append(Label(name, corners, ignore))
    return GroundLabels(
        tuple(dict.fromkeys(label.class_name for label in labels)), tuple(labels), crs
    )


def _shapes(geometry: Mapping[str, Any]) -> list[tuple[Point, ...]]:
    kind, coordinates = geometry["type"], geometry["coordinates"]
    if kind == "Point":
        return [(_point(coordinates),)]
    if kind == "MultiPoint":
        return [(_point(one),) for one in coordinates]
    if kind == "Polygon":
        return [_corners(coordinates[0])]
    if kind == "MultiPolygon":
        return [_corners(outline[0]) for outline in coordinates]
    raise ValueError(kind)


def _point(values: Any) -> Point:
    x, y = float(values[0]), float(values[1])
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError("not finite")
    return x, y


def _corners(ring: Any) -> tuple[Point, ...]:
    points = [_point(values) for values in ring]
    if points[0] == points[-1]:
        points = points[:-1]
    xs, ys = [x for x, _ in points], [y for _, y in points]
    left, top, right, bottom = min(xs), min(ys), max(xs), max(ys)
    if left == right or top == bottom:
        raise ValueError("without size")
    return (
        tuple(points)
        if len(points) == 4
        else ((left, top), (right, top), (right, bottom), (left, bottom))
    )


def _crs(document: Mapping[str, Any], path: Path) -> str:
    member = document.get("crs")
    if member is None:
        return "EPSG:4326"
    try:
        name = str(member["properties"]["name"])
        code = re.search(r"EPSG:(?:[^:]*:)?(\d+)$", name)
        # Both mean WGS 84; GeoJSON has longitude first whatever the system's own order is.
        text = "EPSG:4326" if name.endswith("CRS84") else f"EPSG:{code[1]}" if code else name
        # Within an environment, GDAL's own complaints are not printed.
        with rasterio.Env():
            CRS.from_user_input(text)
    except (KeyError, TypeError, CRSError) as error:
        raise ImageryError(
            f"{path} names a reference system (crs) that is not known; convert it (ogr2ogr -t_srs EPSG:4326)."
        ) from error
    return text
