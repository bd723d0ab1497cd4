"""Outcomes counted per background tile and vehicle of the fleet, for rates and intervals."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import StoredFileError
from skyproof.results.pairs.outcomes import Outcome, read_outcome_table
from skyproof.results.statistics.repeats import DRAWS, SEEDS, Repeat

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
    """Outcomes counted per series and cell, the cells in order.

    The four counts are vehicles in sight, detected in both images, lost (detected in the original
    only) and gained (in the adversarial only).
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


def repeat_of(camouflage: str) -> Repeat:
    """Says by its name which repeat of what a camouflage is: "R-U-1" is a draw of "R-U"."""
    name = CamouflageName.read(camouflage)
    return Repeat(str(name.pooled), name.repeat, DRAWS if name.random else SEEDS)


def read_counts(path: Path) -> OutcomeCounts:
    """Counts the outcomes of a file that `write_outcomes` wrote, series by first occurrence."""
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
    columns = [table[name].combine_chunks().dictionary_encode() for name in names]
    sizes = [max(len(column.dictionary), 1) for column in columns]
    codes = np.ravel_multi_index([column.indices.to_numpy() for column in columns], sizes)
    kinds, first, which = np.unique(codes, return_index=True, return_inverse=True)
    places = np.unravel_index(kinds, sizes)
    values = [
        column.dictionary.take(place).to_pylist()
        for column, place in zip(columns, places, strict=True)
    ]
    return list(zip(*values, strict=True)), first, which.reshape(-1)


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
        if before:
            counts[cells[cell], 0 if after else 1] += 1
        elif after:
            counts[cells[cell], 2] += 1
    return counts
