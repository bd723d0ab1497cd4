"""Finds the field of a vector file that names the classes of its objects."""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skyproof.errors import ImageryError
from skyproof.imagery.labels.label import UNNAMED

# In the order of their precedence: names say more than numbers.
_USUAL = (
    *("class", "category", "label", "type", "classname", "categoryname", "labelname", "typename"),
    *("cls", "objectclass", "objecttype", "vehicleclass", "vehicletype"),
    *("classid", "classvalue", "categoryid", "labelid", "typeid"),
)
_DOCUMENTED = _USUAL[:4]
_DBASE_LETTERS = 10
"""Shapefiles cut the names of fields to this length."""
_SHOWN = 3


def usual_fields(fields: Iterable[str]) -> list[str]:
    """Returns the fields with usual names for classes, in any case, in order of precedence."""
    ranks = {field: _rank(field) for field in fields}
    return sorted((field for field in ranks if ranks[field] < len(_USUAL)), key=ranks.__getitem__)


def _rank(field: str) -> int:
    letters = re.sub(r"[\W_]", "", field.casefold())
    cut = len(field) == _DBASE_LETTERS
    fits = (letters == usual or (cut and usual.startswith(letters)) for usual in _USUAL)
    return next((rank for rank, fit in enumerate(fits) if fit), len(_USUAL))


def chosen_field(fields: Iterable[str], wanted: Sequence[str]) -> str | None:
    """Returns the field that wanted classes of the form FIELD=CLASS name, if it is there."""
    named = {choice.partition("=")[0] for choice in wanted if "=" in choice}
    return next((field for field in fields if field in named), None)


def name_classes(
    records: Sequence[Mapping[str, Any]], wanted: Sequence[str], path: Path
) -> tuple[list[str], str, tuple[str, ...]]:
    """Returns the class name of every object, their field, and a note on every guess.

    A name is empty if the field is. There is no field if every object counts as a vehicle.

    The field is the one that the wanted classes name; else a usual field, or else one of text, that
    holds all wanted classes. Without wanted classes it is a usual field that differs among objects,
    or else any usual field.

    Raises:
        ImageryError: several fields may be meant, the one that the wanted classes name is missing,
            or an object has several values in it.
    """
    every = records[0] if records else ()
    fields = [field for field in every if any(_given(record[field]) for record in records)]
    chosen = chosen_field(fields, wanted)
    if chosen is not None:
        names = _names(records, [chosen], path)
        return [f"{chosen}={name}" if name else "" for name in names], chosen, ()
    usual = usual_fields(fields)
    names_by = {field: _names(records, [field, *usual], path) for field in usual}
    holding = [field for field in usual if _holds(names_by[field], wanted)]
    texts: list[str] = []
    if not holding:
        texts = [one for one in fields if one not in usual and _is_telling_text(records, one)]
    if wanted:
        names_by |= {field: _names(records, [field, *usual], path) for field in texts}
        holding += [field for field in texts if _holds(names_by[field], wanted)]
        if len({tuple(name in wanted for name in names_by[field]) for field in holding}) > 1:
            raise _unclear(records, holding, path)
    missing = [choice.partition("=")[0] for choice in wanted if "=" in choice]
    if records and missing and not holding:
        what = f"{missing[0]!r}" + (" with values" if missing[0] in records[0] else "")
        known = ", ".join(fields)[:500] or "none"
        raise ImageryError(f"{path} has no field {what}; choose from those that it has: {known}.")
    field = next(iter([*holding, *usual]), None)
    if field is None and texts and {*wanted} != {UNNAMED}:
        raise _unclear(records, [*dict.fromkeys([*texts, *fields])], path)
    if field is None:
        note = (
            f"no field of {path} names classes, as far as known: every object counts as a vehicle "
            f"(fields: {', '.join(fields)[:300]})"
        )
        return [UNNAMED] * len(records), "", (note,) if fields else ()
    names = names_by[field]
    rest = ", ".join(repr(other) for other in usual if other != field)
    alike = texts and not wanted and len({*names}) == 1
    if field in _DOCUMENTED and not rest and not alike:
        return names, field, ()
    note = f"the classes of {path} are read from its field {field!r}"
    note += f" and, where it is empty, from {rest}" if rest else ""
    return names, field, (f"{note}: every object is called {names[0]!r}" if alike else note,)


def _holds(names: Sequence[str], wanted: Sequence[str]) -> bool:
    """Whether all wanted classes occur, or, without any wanted, several classes."""
    return {*wanted} <= {*names} if wanted else len({*names}) > 1


def _unclear(
    records: Sequence[Mapping[str, Any]], fields: Sequence[str], path: Path
) -> ImageryError:
    values = {
        field: [*dict.fromkeys(str(record[field]) for record in records if _given(record[field]))]
        for field in fields
    }
    told = ", ".join(
        f"{field} ({', '.join(its[:_SHOWN])[:60]}{', ...' if len(its) > _SHOWN else ''})"
        for field, its in values.items()
    )
    return ImageryError(
        f"{path} does not say which of its fields names the classes: {told[:600]}; put the field "
        f"before each vehicle class (such as --labels.classes {fields[0]}="
        f"{values[fields[0]][0][:60]}), or say --labels.classes {UNNAMED} if every object is one."
    )


def _given(value: Any) -> bool:
    return isinstance(value, np.ndarray | list) or (value is not None and value != "")


def _is_telling_text(records: Sequence[Mapping[str, Any]], field: str) -> bool:
    """Whether a field holds several texts, which may be classes."""
    values = [record[field] for record in records if _given(record[field])]
    return all(isinstance(value, str) for value in values) and len({*values}) > 1


def _names(records: Sequence[Mapping[str, Any]], fields: Sequence[str], path: Path) -> list[str]:
    """Returns the first value that each object has in `fields`, as text; empty without any."""
    names = []
    for number, record in enumerate(records, 1):
        field = next((field for field in fields if _given(record[field])), None)
        value = "" if field is None else record[field]
        if isinstance(value, list | dict | np.ndarray):
            raise ImageryError(
                f"{path} object {number} has several values as its {field!r}; give one."
            )
        names.append(str(value))
    return names
