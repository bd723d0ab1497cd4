"""Counts per background tile and vehicle of the fleet.

They are all that success rates and their intervals need of any number of vehicles.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int
from msgspec import Meta

from skyproof.errors import StoredFileError
from skyproof.files import write_beside
from skyproof.ranges import Name
from skyproof.results.pairs.outcomes import Match, Outcome
from skyproof.results.pairs.parquet import REMEDY, read_table
from skyproof.results.statistics.rates import column_of_pair

Cell = tuple[str, str]
"""A background tile, and a vehicle of the fleet that stands on it once or more."""

_COUNTS = ("in_sight", "both", "lost", "gained")


class Series(NamedTuple):
    """What was compared: one camouflage as one detector sees it.

    The match criterion and the renderer are part of it.
    """

    camouflage: str
    renderer: str
    detector: str
    match: str


_NAMES = (*Series._fields, "background", "vehicle")
_Vehicles = Annotated[int, Meta(ge=0, le=10**9)]
_HINTS = {**dict.fromkeys(_NAMES, Name), "match": Match, **dict.fromkeys(_COUNTS, _Vehicles)}
_MOST_CELLS = 500_000
_MOST_COUNTS = 30_000_000
_SCHEMA = pa.schema(
    [(name, pa.string()) for name in _NAMES] + [(name, pa.int64()) for name in _COUNTS]
)


@dataclass(frozen=True)
class TileCounts:
    """Vehicles per series, background tile and vehicle of the fleet.

    Attributes:
        cells: the N pairs of tile and vehicle, in order.
        series: per series `[N, 4]`: vehicles in sight, detected in both images, lost (in the
            original only), gained (in the adversarial only). Vehicles missed in both count in the
            first column alone.
    """

    cells: tuple[Cell, ...]
    series: Mapping[Series, Int[np.ndarray, "N 4"]]


def count_tiles(outcomes: Iterable[Outcome]) -> TileCounts:
    """Counts outcomes per series, tile and vehicle; series keep the order of their first outcome.

    The vehicles of one fleet are told apart by their names.
    """
    counted: dict[Series, dict[Cell, list[int]]] = {}
    for outcome in outcomes:
        key = Series(outcome.camouflage, outcome.renderer, outcome.detector, outcome.match)
        cell = (outcome.background, outcome.vehicle)
        counts = counted.setdefault(key, {}).setdefault(cell, [0, 0, 0, 0])
        counts[0] += 1
        column = _column(outcome)
        if column is not None:
            counts[1 + column] += 1
    cells = sorted({cell for found in counted.values() for cell in found})
    blank = [0, 0, 0, 0]
    return TileCounts(
        tuple(cells),
        {
            key: np.array([found.get(cell, blank) for cell in cells])
            for key, found in counted.items()
        },
    )


def count_cells(outcomes: Sequence[Outcome], cells: Mapping[Cell, int]) -> Int[np.ndarray, "N 3"]:
    """Counts the pairs (both, lost, gained) per tile and vehicle.

    `cells` maps each tile and vehicle to its row.
    """
    counts = np.zeros((len(cells), 3), dtype=np.int64)
    for outcome in outcomes:
        column = _column(outcome)
        if column is not None:
            counts[cells[outcome.background, outcome.vehicle], column] += 1
    return counts


def write_tiles(path: Path, tiles: TileCounts) -> None:
    """Writes one row per series, tile and vehicle in sight, as Parquet, whole or not at all."""
    stacked = (
        np.stack(list(tiles.series.values()))
        if tiles.series
        else np.zeros((0, len(tiles.cells), 4), np.int64)
    )
    which, cell = np.nonzero(stacked[..., 0])
    names = [
        pa.array([key[field] for key in tiles.series], pa.string()).take(pa.array(which))
        for field in range(4)
    ]
    names += [
        pa.array([each[part] for each in tiles.cells], pa.string()).take(pa.array(cell))
        for part in range(2)
    ]
    counts = [pa.array(column, pa.int64()) for column in stacked[which, cell].T]
    with write_beside(path) as temporary:
        pq.write_table(pa.Table.from_arrays([*names, *counts], schema=_SCHEMA), temporary)


def read_tiles(path: Path) -> TileCounts:
    """Reads what `write_tiles` wrote.

    Raises:
        StoredFileError: the file is missing, not Parquet, has other columns, or counts that cannot
            be.
    """
    table = read_table(path, _SCHEMA, _HINTS)
    names, codes = zip(*(_coded(table, name) for name in _NAMES), strict=True)
    counts = np.stack([table[name].to_numpy() for name in _COUNTS], axis=1)
    keys, first, which = np.unique(
        np.stack(codes[:4], axis=1), axis=0, return_index=True, return_inverse=True
    )
    which = which.reshape(-1)
    pairs, place = np.unique(np.stack(codes[4:], axis=1), axis=0, return_inverse=True)
    found = [(names[4][tile], names[5][vehicle]) for tile, vehicle in pairs]
    cells = sorted(found)
    if len(cells) > _MOST_CELLS or len(cells) * len(keys) > _MOST_COUNTS:
        raise StoredFileError(
            f"{path} counts {len(keys):,} series of {len(cells):,} vehicles on tiles, more than "
            f"the {_MOST_COUNTS:,} counts of {_MOST_CELLS:,} that are read; score fewer at once."
        )
    row_of = {cell: row for row, cell in enumerate(cells)}
    rows = np.array([row_of[cell] for cell in found], dtype=np.int64)[place.reshape(-1)]
    repeated = len(np.unique(which * len(cells) + rows)) < len(which)
    if repeated or (counts[:, 1:].sum(axis=1) > counts[:, 0]).any():
        raise StoredFileError(f"{path} holds counts that contradict each other; {REMEDY}.")
    dense = np.zeros((len(keys), len(cells), 4), dtype=np.int64)
    dense[which, rows] = counts
    order = np.argsort(first)
    named = [Series(*(names[field][code] for field, code in enumerate(keys[row]))) for row in order]
    return TileCounts(tuple(cells), dict(zip(named, dense[order], strict=True)))


def _column(outcome: Outcome) -> int | None:
    return column_of_pair(before=outcome.detected_original, after=outcome.detected_adversarial)


def _coded(table: pa.Table, name: str) -> tuple[list[str], Int[np.ndarray, " rows"]]:
    """Gives a column's different strings, and per row the index of its own."""
    coded = table[name].combine_chunks().dictionary_encode()
    return coded.dictionary.to_pylist(), coded.indices.to_numpy()
