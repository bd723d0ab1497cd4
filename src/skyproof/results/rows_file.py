"""Files of flat rows, `{"rows": [...]}`: what is undefined is null in them and nan in memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.ranges import limits_of

T = TypeVar("T")


def nulls_for_undefined(values: Mapping[str, Any]) -> dict[str, Any]:
    """Gives the values with None in place of nan, which JSON does not have."""
    return {name: None if value != value else value for name, value in values.items()}


def write_rows(path: Path, rows: Iterable[object]) -> None:
    """Writes flat dataclasses as rows, whole or not at all.

    Raises:
        RunFolderError: the disk cannot take it.
    """
    write_json(path, {"rows": [nulls_for_undefined(vars(row)) for row in rows]})


def read_rows(path: Path, kind: type[T], remedy: str) -> list[T]:
    """Reads what `write_rows` wrote.

    Args:
        path: the file.
        kind: a flat dataclass with limits on its fields; its numbers may be undefined.
        remedy: what the error advises.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    form: Any = kind
    document = read_document(path, _document(form), remedy)
    return [kind(**filled_row(row)) for row in document.rows]


def filled_row(row: msgspec.Struct) -> dict[str, Any]:
    """Gives the values of a row of a form from `row_form`, nan where it holds null."""
    values = {name: getattr(row, name) for name in row.__struct_fields__}
    return {name: math.nan if value is None else value for name, value in values.items()}


@cache
def _document(kind: Any) -> Any:
    row: Any = row_form(kind)
    return msgspec.defstruct("Rows", [("rows", list[row])])


@cache
def row_form(kind: Any) -> Any:
    """Gives the form of rows of a flat dataclass: each number that is a fraction may be null."""
    hints = limits_of(kind)
    given = [
        (
            each.name,
            _nullable(hints[each.name]),
            *([] if each.default is MISSING else [each.default]),
        )
        for each in fields(kind)
    ]
    form: Any = msgspec.defstruct(kind.__name__, given, forbid_unknown_fields=True)
    return form


def _nullable(hint: Any) -> Any:
    return hint | None if getattr(hint, "__origin__", hint) is float else hint
