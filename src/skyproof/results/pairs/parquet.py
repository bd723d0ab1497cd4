"""Reads Parquet tables that this package wrote and refuses others."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from skyproof.errors import StoredFileError

REMEDY = "copy the whole folder again, or score again"
"""Advice on a damaged table of scores."""

_MOST_ROWS = 10_000_000
_LARGEST_BYTES = 2**32


def read_table(
    path: Path,
    schema: pa.Schema,
    hints: Mapping[str, Any],
    *,
    undefined: Collection[str] = (),
    columns: Sequence[str] | None = None,
) -> pa.Table:
    """Reads the table at `path`.

    Args:
        path: the file.
        schema: required columns.
        hints: annotation with the limits of values, by column.
        undefined: columns whose numbers may be nan.
        columns: columns to read; all by default.

    Raises:
        StoredFileError: the file is missing, not Parquet, too large, has other columns than
            `schema`, or values that are missing or out of their limits.
    """
    if not path.exists():
        raise StoredFileError(f"{path} is missing; {REMEDY}, or give another run folder.")
    try:
        wanted = list(schema.names if columns is None else columns)
        table = _read(path, schema, wanted)
        for name in wanted:
            _check(table[name], hints.get(name), name in undefined)
        return table.cast(pa.schema([schema.field(name) for name in wanted]))
    except _UnfitTable as unfit:
        said = str(unfit)
    except msgspec.ValidationError as error:
        reason = str(error).partition(" - at ")[0]
        said = f"has a value in its column {name} that cannot be ({reason})"
    except Exception as error:
        # The readers of Parquet meet damage with many exceptions.
        said = f"is not a readable Parquet file ({' '.join(str(error).split())[:200]})"
    raise StoredFileError(f"{path} {said.rstrip('.')}; {REMEDY}.")


class _UnfitTable(Exception):
    """What is wrong with a table."""


def _read(path: Path, schema: pa.Schema, columns: list[str]) -> pa.Table:
    """Reads a table whose texts are kept as dictionaries: a long one is in memory once."""
    metadata = pq.read_metadata(path)
    stored = metadata.schema.to_arrow_schema()
    if not stored.equals(schema):
        differing = ", ".join(sorted(set(schema.names) ^ set(stored.names))) or "their types"
        raise _UnfitTable(f"has other columns than this version writes ({differing[:200]})")
    size = sum(
        metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups)
    )
    if metadata.num_rows > _MOST_ROWS or size > _LARGEST_BYTES:
        raise _UnfitTable(f"has {metadata.num_rows:,} rows, more than are read ({_MOST_ROWS:,})")
    texts = [field.name for field in schema if field.type == pa.string()]
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        return file.read(columns=columns)


def _check(column: pa.ChunkedArray, hint: Any, may_be_undefined: bool) -> None:
    if column.null_count:
        raise _UnfitTable("has empty cells")
    if hint is None or not len(column):
        return
    if pa.types.is_dictionary(column.type):
        for chunk in column.chunks:
            msgspec.convert(chunk.dictionary.to_pylist(), list[hint])
        return
    if pa.types.is_floating(column.type):
        column = column.filter(pc.invert(pc.is_nan(column))) if may_be_undefined else column
        if not len(column):
            return
        if pc.any(pc.is_nan(column)).as_py():
            raise _UnfitTable("holds numbers that are not finite")
    ends = pc.min_max(column).as_py()
    msgspec.convert([ends["min"], ends["max"]], list[hint])
