"""Files of flat rows, `{"rows": [...]}`, with null in place of nan.

A row is a dataclass. An interval takes three columns ("easr", "easr_low", "easr_high"), any other
part one for each of its attributes ("best_threshold"), null without such a part.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec

from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.ranges import limits_of
from skyproof.results.statistics.intervals import Interval

T = TypeVar("T")


def nulls_for_undefined(values: Mapping[str, Any]) -> dict[str, Any]:
    """Gives the values with None in place of nan, which JSON does not have."""
    return {name: None if value != value else value for name, value in values.items()}


def interval_columns(name: str, interval: Interval) -> dict[str, float]:
    """Gives the three columns of an interval."""
    return {name: interval.estimate, f"{name}_low": interval.low, f"{name}_high": interval.high}


def write_rows(path: Path, rows: Iterable[object]) -> None:
    """Writes rows, whole or not at all."""
    write_json(path, {"rows": [flat_row(row) for row in rows]})


def read_rows(path: Path, kind: type[T], remedy: str) -> list[T]:
    """Reads rows of a dataclass with limits on its fields; numbers may be undefined.

    Raises:
        StoredFileError: the file is missing or of another form; gives the `remedy`.
    """
    form: Any = kind
    document = read_document(path, _document(form), remedy)
    return [row_of(form, row) for row in document.rows]


def flat_row(row: object) -> dict[str, Any]:
    """Gives a row as JSON values."""
    kind: Any = type(row)
    values: dict[str, Any] = {}
    for name, columns in _parts(kind).items():
        value = getattr(row, name)
        if columns is None:
            values[name] = value
        else:
            for attribute, column in columns.items():
                values[column] = None if value is None else getattr(value, attribute)
    return nulls_for_undefined(values)


def row_of(kind: Any, stored: msgspec.Struct) -> Any:
    """Makes a row of a kind of what was read by its `row_form`."""
    values: dict[str, Any] = {}
    for name, columns in _parts(kind).items():
        if columns is None:
            values[name] = _filled(getattr(stored, name))
            continue
        part = _part(limits_of(kind)[name])
        parts = {attribute: getattr(stored, column) for attribute, column in columns.items()}
        missing = part is not Interval and set(parts.values()) == {None}
        filled = {attribute: _filled(value) for attribute, value in parts.items()}
        values[name] = None if missing else part(**filled)
    return kind(**values)


@cache
def row_form(kind: Any) -> Any:
    """Gives the form of a row's JSON values: each number that is a fraction may be null."""
    given: list[tuple[Any, ...]] = []
    for each in fields(kind):
        hint = limits_of(kind)[each.name]
        default = () if each.default is MISSING else (each.default,)
        given += [(name, _nullable(own), *default) for name, own in _hints(each.name, hint)]
    form: Any = msgspec.defstruct(kind.__name__, given, forbid_unknown_fields=True, kw_only=True)
    return form


@cache
def _document(kind: Any) -> Any:
    row: Any = row_form(kind)
    return msgspec.defstruct("Rows", [("rows", list[row])])


@cache
def _parts(kind: Any) -> dict[str, dict[str, str] | None]:
    """Per field of a row None where it is one column, else the columns of its attributes."""
    return {each.name: _columns(each.name, limits_of(kind)[each.name]) for each in fields(kind)}


def _columns(name: str, hint: Any) -> dict[str, str] | None:
    part = _part(hint)
    if part is Interval:
        return {"estimate": name, "low": f"{name}_low", "high": f"{name}_high"}
    return part and {each.name: f"{name}_{each.name}" for each in fields(part)}


def _hints(name: str, hint: Any) -> Iterator[tuple[str, Any]]:
    """The columns of a field, each with its limits; an interval's are those of all its numbers."""
    part = _part(hint)
    for attribute, column in (_columns(name, hint) or {"": name}).items():
        if part is Interval:
            yield column, Annotated[(float, *hint.__metadata__)]
        else:
            yield column, hint if part is None else limits_of(part)[attribute]


def _part(hint: Any) -> Any:
    """The dataclass that a field holds, or None: of `Annotated[Interval, ...]`, `BestF1 | None`."""
    return next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind)), None)


def _nullable(hint: Any) -> Any:
    return hint | None if getattr(hint, "__origin__", hint) is float else hint


def _filled(value: Any) -> Any:
    return math.nan if value is None else value
