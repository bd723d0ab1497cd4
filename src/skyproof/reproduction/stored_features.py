"""What a detector's feature pyramid holds at vehicles and at bare ground, as one Parquet table.

The rows are plain data and need no torch.
"""

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
from skyproof.results.pairs.outcomes import REMEDY, read_table

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

    Attributes:
        detector: its name.
        shown: the camouflage's name, "original" or `GROUND`.
        scenes: per row the scene's id.
        backgrounds: per row the scene's background tile.
        placements: per row the vehicle's index in `Scene.placements`; of ground, that of the
            vehicle as large as the box.
        vectors: per row the features.
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
        {
            "detector": each.detector,
            "shown": each.shown,
            "scene": scene,
            "background": background,
            "placement": placement,
            "features": vector,
        }
        for each in every
        for scene, background, placement, vector in zip(
            each.scenes, each.backgrounds, each.placements, each.vectors, strict=True
        )
    ]
    with write_beside(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=_SCHEMA), temporary)


def read_features(path: Path) -> list[Features]:
    """Reads what `write_features` wrote, by detector and by what is shown.

    Raises:
        StoredFileError: the file is missing, not Parquet, or has other columns, values that cannot
            be, or vectors of different lengths of one detector.
    """
    table = read_table(path, _SCHEMA, _HINTS)
    if not len(table):
        return []
    columns = {name: table[name].to_pylist() for name in (*_NAMES, "placement")}
    vectors = table["features"].combine_chunks()
    numbers = vectors.flatten().to_numpy(zero_copy_only=False)
    if vectors.flatten().null_count or not np.isfinite(numbers).all():
        raise StoredFileError(f"{path} holds features that are no finite numbers; {REMEDY}.")
    ends = vectors.offsets.to_numpy() - vectors.offsets[0].as_py()
    rows: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(columns["detector"], columns["shown"], strict=True)):
        rows.setdefault(key, []).append(row)
    lengths: dict[str, set[int]] = {}
    for row, detector in enumerate(columns["detector"]):
        lengths.setdefault(detector, set()).add(int(ends[row + 1] - ends[row]))
    uneven = next((name for name, found in lengths.items() if len(found) > 1 or 0 in found), None)
    if uneven is not None:
        raise StoredFileError(
            f"{path} holds vectors of different lengths of {uneven}, or empty ones; {REMEDY}."
        )
    return [
        Features(
            detector,
            shown,
            [columns["scene"][row] for row in chosen],
            [columns["background"][row] for row in chosen],
            [columns["placement"][row] for row in chosen],
            np.stack([numbers[ends[row] : ends[row + 1]] for row in chosen]).astype(np.float64),
        )
        for (detector, shown), chosen in rows.items()
    ]
