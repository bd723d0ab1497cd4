"""Outcomes counted per background tile and vehicle of the fleet, for rates and intervals."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from skyproof.errors import StoredFileError
from skyproof.results.pairs.outcomes import Outcome, read_outcome_table
from skyproof.results.statistics.rates import column_of_pair

Cell = tuple[str, str]
"""A background tile, and a vehicle of the fleet on it."""


class Series(NamedTuple):
    """Names of one series of outcomes."""

    camouflage: str
    renderer: str
    detector: str
    match: str


_CELL = ("background", "vehicle")
_FOUND = ("detected_original", "detected_adversarial")
_MOST_CELLS = 500_000
_MOST_COUNTS = 30_000_000


@dataclass(frozen=True)
class OutcomeCounts:
    """Outcomes counted per series, background tile and vehicle of the fleet.

    Attributes:
        cells: the N pairs of tile and vehicle, in order.
        series: per series `[N, 4]`: vehicles in sight, detected in both images, lost (detected in
            the original only), gained (in the adversarial only).
    """

    cells: tuple[Cell, ...]
    series: Mapping[Series, Int[np.ndarray, "N 4"]]

    @property
    def tiles(self) -> int:
        """Number of background tiles."""
        return len({tile for tile, _ in self.cells})

    def of(self, renderer: str, match: str) -> "OutcomeCounts":
        """Gives the series of one renderer and match rule, on the cells that they show."""
        series = {
            key: counts
            for key, counts in self.series.items()
            if (key.renderer, key.match) == (renderer, match)
        }
        shown = np.any([counts[:, 0] > 0 for counts in series.values()], axis=0)
        return replace(
            self,
            cells=tuple(itertools.compress(self.cells, shown)),
            series={key: counts[shown] for key, counts in series.items()},
        )


def read_counts(path: Path) -> OutcomeCounts:
    """Counts the outcomes of a file that `write_outcomes` wrote, series by first occurrence.

    Raises:
        StoredFileError: the file is missing, not Parquet, has other columns, values that cannot
            be, or more of them than are read.
    """
    table = read_outcome_table(path, [*Series._fields, *_CELL, *_FOUND])
    keys, first, series = _numbered(table, Series._fields)
    found, _, place = _numbered(table, _CELL)
    pairs = [(tile, vehicle) for tile, vehicle in found]
    cells = sorted(pairs)
    if len(cells) > _MOST_CELLS or len(cells) * len(keys) > _MOST_COUNTS:
        raise StoredFileError(
            f"{path} holds {len(keys):,} series of {len(cells):,} vehicles on tiles, more than "
            f"the {_MOST_COUNTS:,} counts of {_MOST_CELLS:,} that are read; score fewer at once."
        )
    row_of = {cell: row for row, cell in enumerate(cells)}
    rows = np.array([row_of[cell] for cell in pairs], dtype=np.int64)[place]
    position = series * len(cells) + rows
    before, after = (table[name].to_numpy() for name in _FOUND)
    shown = (np.ones_like(before), before & after, before & ~after, ~before & after)
    counts = [
        np.bincount(position[mask], minlength=len(keys) * len(cells)).reshape(len(keys), len(cells))
        for mask in shown
    ]
    dense = np.stack(counts, axis=-1).astype(np.int64)
    named = {Series(*keys[row]): dense[row] for row in np.argsort(first)}
    return OutcomeCounts(tuple(cells), named)


def _numbered(
    table: pa.Table, names: Sequence[str]
) -> tuple[list[tuple[str, ...]], Int[np.ndarray, " K"], Int[np.ndarray, " rows"]]:
    """Gives the K different rows of some columns, their first places, and each row's number."""
    codes = np.zeros(len(table), dtype=np.int64)
    values: list[list[str]] = []
    for name in names:
        coded = table[name].combine_chunks().dictionary_encode()
        values.append(coded.dictionary.to_pylist())
        codes = codes * max(len(values[-1]), 1) + coded.indices.to_numpy()
    kinds, first, which = np.unique(codes, return_index=True, return_inverse=True)
    rows = []
    for code in kinds.tolist():
        parts = []
        for known in reversed(values):
            code, index = divmod(code, len(known))
            parts.append(known[index])
        rows.append(tuple(reversed(parts)))
    return rows, first, which.reshape(-1)


def count_cells(outcomes: Sequence[Outcome], cells: Mapping[Cell, int]) -> Int[np.ndarray, "N 3"]:
    """Counts the pairs (both, lost, gained) per tile and vehicle, by the rows in `cells`."""
    return count_pairs(
        (
            ((each.background, each.vehicle), each.detected_original, each.detected_adversarial)
            for each in outcomes
        ),
        cells,
    )


def count_pairs(
    pairs: Iterable[tuple[Cell, bool, bool]], cells: Mapping[Cell, int]
) -> Int[np.ndarray, "N 3"]:
    """Counts (both, lost, gained) per cell from vehicles found or missed before and after."""
    counts = np.zeros((len(cells), 3), dtype=np.int64)
    for cell, before, after in pairs:
        column = column_of_pair(before=before, after=after)
        if column is not None:
            counts[cells[cell], column] += 1
    return counts
