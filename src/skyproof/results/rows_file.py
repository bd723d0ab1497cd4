"""Files of flat rows, `{"rows": [...]}`, with null in place of nan.

A row is a dataclass. An interval takes three columns ("easr", "easr_low", "easr_high"), any other
nested dataclass one per attribute ("best_threshold"), null if it is missing.
"""

import math
from collections.abc import Iterable, Mapping
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
    """Returns the values with None in place of nan, which JSON does not have."""
    return {name: None if value != value else value for name, value in values.items()}


def interval_columns(name: str, interval: Interval) -> dict[str, float]:
    """Returns the three columns of an interval."""
    return {name: interval.estimate, f"{name}_low": interval.low, f"{name}_high": interval.high}


def write_rows(path: Path, rows: Iterable[object]) -> None:
    """Writes rows, whole or not at all."""
    write_json(path, {"rows": [flat_row(row) for row in rows]})


def read_rows(path: Path, kind: type[T], remedy: str) -> list[T]:
    """Reads rows of a dataclass with limits on its fields; numbers may be undefined."""
    form: Any = kind
    row: Any = row_form(form)
    document: Any = msgspec.defstruct("Rows", [("rows", list[row])])
    return [row_of(form, stored) for stored in read_document(path, document, remedy).rows]


def flat_row(row: object) -> dict[str, Any]:
    """Returns a row as JSON values."""
    kind: Any = type(row)
    values: dict[str, Any] = {}
    for name, (part, columns) in _fields(kind).items():
        value = getattr(row, name)
        for attribute, column, _ in columns:
            values[column] = value if part is None or value is None else getattr(value, attribute)
    return nulls_for_undefined(values)


def row_of(kind: Any, stored: msgspec.Struct) -> Any:
    """Makes a row of this dataclass from what its `row_form` read."""
    values: dict[str, Any] = {}
    for name, (part, columns) in _fields(kind).items():
        given = {attribute: getattr(stored, column) for attribute, column, _ in columns}
        filled = {key: math.nan if value is None else value for key, value in given.items()}
        if part is None:
            (values[name],) = filled.values()
        elif part is not Interval and set(given.values()) == {None}:
            values[name] = None
        else:
            values[name] = part(**filled)
    return kind(**values)


@cache
def row_form(kind: Any) -> Any:
    """Returns the form of a row's JSON values, in which every float may be null."""
    given: list[tuple[Any, ...]] = []
    for each in fields(kind):
        default = () if each.default is MISSING else (each.default,)
        _, columns = _fields(kind)[each.name]
        given += [(column, _nullable(hint), *default) for _, column, hint in columns]
    form: Any = msgspec.defstruct(kind.__name__, given, forbid_unknown_fields=True, kw_only=True)
    return form


@cache
def _fields(kind: Any) -> dict[str, tuple[Any, list[tuple[str, str, Any]]]]:
    """Maps each field to its dataclass, if any, and its columns: attribute, name, limits."""
    found: dict[str, tuple[Any, list[tuple[str, str, Any]]]] = {}
    for name, hint in limits_of(kind).items():
        # The dataclass in `Annotated[Interval, ...]` or `BestF1 | None`.
        part: Any = next((each for each in (hint, *get_args(hint)) if is_dataclass(each)), None)
        if part is None:
            columns = [("", name, hint)]
        elif part is Interval:
            number = Annotated[(float, *hint.__metadata__)]
            ends = {"estimate": name, "low": f"{name}_low", "high": f"{name}_high"}
            columns = [(attribute, column, number) for attribute, column in ends.items()]
        else:
            limits = limits_of(part)
            columns = [(attribute, f"{name}_{attribute}", own) for attribute, own in limits.items()]
        found[name] = part, columns
    return found


def _nullable(hint: Any) -> Any:
    return hint | None if getattr(hint, "__origin__", hint) is float else hint
