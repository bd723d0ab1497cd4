"""Reads labels on the ground: points and outlines of GeoJSON, GeoPackage and Shapefile."""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skyproof.errors import ImageryError
from skyproof.imagery.labels.class_field import chosen_field, name_classes, usual_fields
from skyproof.imagery.labels.image_files import LARGEST_NUMBER
from skyproof.imagery.labels.label import (
    UNNAMED,
    GroundLabels,
    Label,
    Point,
    flat_note,
    outline_corners,
    twice_note,
)
from skyproof.imagery.settings import names_a_system
from skyproof.words import counted

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

# First bytes of GeoPackages and Shapefiles; everything else is GeoJSON.
_BEGINNINGS = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a"}
_LABEL_GEOMETRY = re.compile("Point|Polygon|Surface|Collection|Unknown")


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


def read_ground_labels(
    path: Path, wanted: Sequence[str] = (), system_name: str | None = None
) -> GroundLabels:
    """Reads points and outlines of a vector file, and the classes in the field that names them.

    The four corners of an outline are kept; any other outline becomes the upright box around it.
    Each part of an object is a label of its own. GDAL reads GeoJSON whose `crs` member names an
    unknown system as WGS 84. A property `ignore` that is true marks a region that is not scored.
    """
    known = _BEGINNINGS.get(path.suffix.lower())
    if known is not None and not path.read_bytes().startswith(known):
        raise ImageryError(
            f"{path} is no {path.suffix.lower()} file inside; replace it, or name it as it is."
        )
    # GDAL is told which reader to take, because some of them fetch files from elsewhere.
    place = path if known is not None else f"GeoJSON:{path}"
    frame, notes = _read_layer(place, path, wanted)
    if frame.empty or "geometry" not in frame:
        raise ImageryError(f"{path} holds no objects (features); give another file.")
    crs = None if frame.crs is None else frame.crs.to_string()
    if crs == "EPSG:4326" and system_name is not None:
        crs = crs if re.search("4326|CRS84", system_name) else None
    if crs is None:
        raise _unknown_system(path)
    # Integers stay integers if some objects have none.
    properties = frame.drop(columns="geometry").convert_dtypes()
    records = properties.astype(object).where(properties.notna(), None).to_dict("records")
    names, field, guesses = name_classes(records, wanted, path)
    unnamed = sum(
        not name and not _is_ignored(record) for name, record in zip(names, records, strict=True)
    )
    labels: list[Label] = []
    parts: list[int] = []
    flat: list[str] = []
    rows = zip(frame.geometry, records, names, strict=True)
    for number, (geometry, record, name) in enumerate(rows, 1):
        where = f"{path} object {number}"
        if geometry is None or geometry.is_empty:
            parts.append(1)
            flat.append(where)
            continue
        shapes = [_corners(part) for part in getattr(geometry, "geoms", [geometry])]
        if not shapes or not all(shapes):
            raise ImageryError(
                f"{where} is neither a point nor a polygon with coordinates; correct it."
            )
        parts.append(len(shapes))
        flat += [where for corners in shapes if _is_flat(corners)]
        for corners in shapes:
            if crs == "EPSG:4326" and any(abs(x) > 180 or abs(y) > 90 for x, y in corners):
                raise ImageryError(
                    f"{where} is at {corners[0][0]:g}, {corners[0][1]:g}, which is no longitude "
                    "and latitude; name the reference system in the file, or convert it (ogr2ogr "
                    "-t_srs EPSG:4326)."
                )
            if not _is_flat(corners):
                labels.append(Label(name or UNNAMED, corners, _is_ignored(record)))
    single = tuple(dict.fromkeys(labels))
    several = [count for count in parts if count > 1]
    if several:
        objects = counted(len(several), "object")
        notes += (f"counted the {sum(several)} parts of {objects} of {path} as one label each",)
    notes += guesses
    if unnamed:
        role = "ignore regions" if wanted and UNNAMED not in wanted else repr(UNNAMED)
        told = f"{unnamed} of {len(names)}"
        notes += (f"objects of {path} that name no class ({told}) count as {role}",)
    notes += twice_note(len(labels) - len(single), path)
    notes += flat_note(flat, sum(parts), path, "outlines that enclose ground, or points")
    classes = dict.fromkeys(label.class_name for label in single)
    return GroundLabels(tuple(classes), single, crs, notes, field)


def _is_ignored(record: Mapping[str, Any]) -> bool:
    # Shapefiles have no truth values, only numbers, and often names in capitals.
    return any(
        str(value) in ("True", "1") for key, value in record.items() if key.casefold() == "ignore"
    )


def _read_layer(
    place: Path | str, path: Path, wanted: Sequence[str]
) -> "tuple[GeoDataFrame, tuple[str, ...]]":
    """Reads the one layer of a vector file that may hold labels, and tells of the others."""
    # Imported only for labels on the ground, because the import takes a second.
    import geopandas

    try:
        with warnings.catch_warnings():
            # The errors of objects name what GDAL warns of.
            warnings.simplefilter("ignore")
            layers = geopandas.list_layers(place)["name"].tolist()
            fitting = layers if len(layers) == 1 else _label_layers(place, layers, wanted)
            name = next(iter([*fitting, *layers]))
            frame = geopandas.read_file(place, layer=name, on_invalid="ignore")
    except Exception as error:  # GDAL, pyogrio, shapely and pyproj each raise their own types
        reason = " ".join(str(error).split())[:200]
        raise ImageryError(f"{path} cannot be read ({reason}); give another file.") from error
    if len(fitting) > 1:
        raise ImageryError(
            f"{path} holds {len(fitting)} layers that may be labels ({', '.join(fitting)[:300]}); "
            f"give a file of one (ogr2ogr one.gpkg {path.name} {fitting[0]})."
        )
    others = ", ".join(other for other in layers if other != name)[:300]
    note = f"of {path} the layer {name!r} is read, and not {others}"
    return frame, (note,) if others else ()


def _label_layers(place: Path | str, layers: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Returns the layers of points or outlines: only one if it alone has a field for classes."""
    import pyogrio

    infos = {name: pyogrio.read_info(place, layer=name) for name in layers}
    fitting = [
        name
        for name, info in infos.items()
        if info["features"] and _LABEL_GEOMETRY.search(info["geometry_type"] or "")
    ]
    fields = {name: infos[name]["fields"] for name in fitting}
    telling = [one for one, its in fields.items() if chosen_field(its, wanted) or usual_fields(its)]
    return telling if len(telling) == 1 else fitting


def _is_flat(corners: Sequence[Point]) -> bool:
    """Whether an outline encloses no ground."""
    return len(corners) > 1 and any(len({*values}) == 1 for values in zip(*corners, strict=True))


def _corners(part: Any) -> tuple[Point, ...]:
    """Returns the corners of a point or an outline; nothing of anything else."""
    if part.is_empty or not (np.abs(part.bounds) <= LARGEST_NUMBER).all():
        return ()
    if part.geom_type == "Point":
        return ((part.x, part.y),)
    if part.geom_type != "Polygon":
        return ()
    return outline_corners([(x, y) for x, y, *_ in part.exterior.coords[:-1]])
