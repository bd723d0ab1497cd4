"""Counts without the outcomes that they are made of, and outcomes for given counts."""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from skyproof.results.outcomes import (
    Outcome,
    OutcomeCounts,
    outcome_table,
    read_counts,
    write_outcomes,
)


def count_outcomes(outcomes: Iterable[Outcome]) -> OutcomeCounts:
    """Counts outcomes as they are read from a score folder."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "outcomes.parquet"
        write_outcomes(path, outcomes)
        return read_counts(path)


def on_tiles(names, series):
    """Counts `[C, 4]` per series on tiles of these names, with a single vehicle on every tile."""
    return OutcomeCounts(tuple((name, "car") for name in names), series)


def write_counts(path, tiles):
    """Writes outcomes that give these counts; all else is alike in them."""
    schema = outcome_table([]).schema
    tables = [outcome_table([])]
    for key, counts in tiles.series.items():
        both, lost, gained = counts[:, 1], counts[:, 2], counts[:, 3]
        kinds = np.stack([both, lost, gained, counts[:, 0] - both - lost - gained], axis=1)
        kind = np.tile(np.arange(4), len(counts)).repeat(kinds.ravel())
        cell = np.arange(len(counts)).repeat(kinds.sum(axis=1))
        columns = {
            **key._asdict(),
            "body_type": "car",
            "scene": "a",
            "condition": "clear",
            "placement": np.arange(len(kind)),
            "background": np.array([tile for tile, _ in tiles.cells], dtype=object)[cell],
            "vehicle": np.array([vehicle for _, vehicle in tiles.cells], dtype=object)[cell],
            "score_original": 0.9 * (kind < 2),
            "score_adversarial": 0.9 * ((kind == 0) | (kind == 2)),
            "detected_original": kind < 2,
            "detected_adversarial": (kind == 0) | (kind == 2),
        }
        given = [columns.get(field.name, 0.0) for field in schema]
        arrays = [
            pa.array(
                values if isinstance(values, np.ndarray) else [values] * len(kind), type=field.type
            )
            for field, values in zip(schema, given, strict=True)
        ]
        tables.append(pa.Table.from_arrays(arrays, schema=schema))
    pq.write_table(pa.concat_tables(tables), path)
