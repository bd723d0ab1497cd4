"""What a run folder holds of detectors' features and of camouflages' looks; needs no torch."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from msgspec import Meta, Struct

from skyproof.camouflage.name import CamouflageName
from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import write_beside
from skyproof.ranges import FileReference, Fraction, Name, WholeNumber
from skyproof.results.outcomes import REMEDY, read_table
from skyproof.results.stored import Label, Number

GROUND = "ground"
"""Stands in place of a camouflage's name for boxes without a vehicle."""

_REMEDY = "copy the whole folder again, or score again"
_NAMES = ("detector", "shown", "scene", "background")
_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _NAMES),
        ("placement", pa.int32()),
        ("features", pa.list_(pa.field("element", pa.float32()))),
    ]
)
_HINTS = {**dict.fromkeys(_NAMES, Name), "placement": WholeNumber}

_Correlation = Annotated[float, Meta(ge=-1, le=1)]
_Distance = Annotated[float, Meta(ge=0, le=1000)]
_Bins = Annotated[list[Fraction], Meta(min_length=1, max_length=256)]


@dataclass(frozen=True)
class Features:
    """The features of one detector at vehicles with one camouflage, without one, or of the ground.

    `shown` is a camouflage's name, "original" or `GROUND`. Every row has a vector, and a vehicle by
    its index in `Scene.placements`; for ground it is the vehicle whose size the box has.
    """

    detector: str
    shown: str
    scenes: Sequence[str]
    backgrounds: Sequence[str]
    placements: Sequence[int]
    vectors: Float[np.ndarray, "N C"]


def write_features(path: Path, every: Iterable[Features]) -> None:
    """Writes one row per box as one Parquet table, whole or not at all."""
    rows = [
        dict(zip(_SCHEMA.names, (each.detector, each.shown, *row), strict=True))
        for each in every
        for row in zip(each.scenes, each.backgrounds, each.placements, each.vectors, strict=True)
    ]
    with write_beside(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=_SCHEMA), temporary)


def read_features(path: Path) -> list[Features]:
    """Reads what `write_features` wrote, by detector and by what is shown."""
    table = read_table(path, _SCHEMA, _HINTS)
    rows = defaultdict(list)
    lengths = defaultdict(set)
    texts = [table[name].to_pylist() for name in (*_NAMES, "placement")]
    for detector, shown, *place, vector in zip(*texts, table["features"].to_numpy(), strict=True):
        if not np.isfinite(vector).all():
            raise StoredFileError(f"{path} holds features that are no finite numbers; {REMEDY}.")
        rows[detector, shown].append((*place, vector.astype(np.float64)))
        lengths[detector].add(len(vector))
    for detector, found in lengths.items():
        if len(found) > 1 or 0 in found:
            raise StoredFileError(
                f"{path} holds vectors of different lengths of {detector}, or empty ones; {REMEDY}."
            )
    features = []
    for (detector, shown), own in rows.items():
        scenes, backgrounds, placements, vectors = map(list, zip(*own, strict=True))
        features.append(
            Features(detector, shown, scenes, backgrounds, placements, np.stack(vectors))
        )
    return features


class TextureLooks(Struct, frozen=True):
    """Shares of a texture's area by where its colours lie in the RGB cube (section S7).

    One channel or more is at an end at the faces, two or more at the edges, all three at the
    corners. Colours drawn uniformly from [0, 1], and then rounded to 8 bits, have 32.2 % at the
    faces, 4.1 % at the edges and 0.2 % at the corners. The histogram has red, green and blue, each
    from dark to bright.
    """

    name: Name
    faces: Fraction
    edges: Fraction
    corners: Fraction
    histogram: Annotated[list[_Bins], Meta(min_length=3, max_length=3)]


class PairLooks(Struct, frozen=True):
    """How alike two repeats are on the vehicles that wear them.

    The correlation of the values is a mean over the channels; None if one channel of either is
    constant. Unrelated textures have 0. The distance of the colours is a mean in CIELAB (CIE 1976),
    of which 2.3 can just be noticed (Mahy and others 1994). `seen_`
    values are of textures as the renderer reads them.
    """

    first: Name
    second: Name
    correlation: _Correlation | None
    distance: _Distance
    seen_correlation: _Correlation | None
    seen_distance: _Distance


class Strip(Struct, frozen=True):
    """Sample images side by side, with the file relative to `looks.json`."""

    label: Label
    file: FileReference


class Looks(Struct, frozen=True, omit_defaults=True):
    """All that is measured of camouflages; repeats and draws have rows of their own.

    Samples are the same scenes without vehicles, with them, and with camouflages; sensor the same
    vehicles by the renderer's steps towards a photograph.
    """

    vehicles: WholeNumber
    textures: list[TextureLooks]
    pairs: list[PairLooks]
    samples: list[Strip] = []
    sensor: list[Strip] = []


_Measured = dict[Label, Number | bool | None]


class _Signs(Struct, frozen=True):
    texture: _Measured
    shape: _Measured
    total: Number


class Practicality(Struct, frozen=True):
    """One row of `practicality.json`: the effort of making a texture and a shape, if changed."""

    name: Name
    score: _Signs
    texture: _Measured | None = None
    shape: _Measured | None = None


class _PracticalityFile(Struct, frozen=True):
    rows: list[Practicality]


def read_practicality(folder: Path) -> dict[CamouflageName, Practicality]:
    """Reads the practicality of finished attacks, by camouflage without repeat; may be empty."""
    path = folder / "practicality.json"
    if not path.exists():
        return {}
    read: _PracticalityFile = read_document(path, _PracticalityFile, _REMEDY)
    return {CamouflageName.read(row.name).pooled: row for row in read.rows}


def read_looks(folder: Path) -> Looks | None:
    """Reads the looks of camouflages; None if they were not measured."""
    path = folder / "looks.json"
    if not path.exists():
        return None
    return read_document(path, Looks, _REMEDY)
