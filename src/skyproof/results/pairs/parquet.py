"""Reading Parquet tables that this package wrote."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from skyproof.errors import StoredFileError

__all__ = ["read_table"]


def read_table(path: Path, schema: pa.Schema) -> pa.Table:
    """Reads the table at `path`.

    Raises:
        StoredFileError: the file is missing, not Parquet, or has other columns than `schema`.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError as error:
        raise StoredFileError(
            f"{path} is missing; run the evaluation, or give another run folder."
        ) from error
    except (pa.ArrowException, OSError) as error:
        raise StoredFileError(
            f"{path} is not a readable Parquet file ({error}); run the evaluation again."
        ) from error
    if not table.schema.equals(schema):
        difference = sorted(set(schema.names) ^ set(table.schema.names)) or "types"
        raise StoredFileError(
            f"{path} has other columns than this version writes ({difference}); run the evaluation "
            "again."
        )
    return table
