"""A detector's features at vehicles and at bare ground, as one Parquet table; needs no torch."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from skyproof.errors import StoredFileError
from skyproof.files import write_beside
from skyproof.ranges import Name, WholeNumber
from skyproof.results.outcomes import REMEDY, read_table

GROUND = "ground"
"""Stands where a camouflage's name would: no vehicle is in the box."""

_NAMES = ("detector", "shown", "scene", "background")
_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _NAMES),
        ("placement", pa.int32()),
        ("features", pa.list_(pa.field("element", pa.float32()))),
    ]
)
_HINTS = {**dict.fromkeys(_NAMES, Name), "placement": WholeNumber}


@dataclass(frozen=True)
class Features:
    """The features of one detector at vehicles with one camouflage, without one, or of the ground.

    Shown is the camouflage's name, "original" or `GROUND`. Every row has a vector, and a vehicle by
    its index in `Scene.placements`; of ground, that of the vehicle as large as the box.
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
