"""One validated read for every stored document: JSON files and files of JSON lines.

The kind of a document is a dataclass or a `msgspec.Struct` whose annotations give types, ranges and
names (`skyproof.ranges`). msgspec checks while it parses, names the place of a mistake, accepts our
dataclasses, skips unwanted fields without keeping them, and needs no other package. pydantic would
keep the whole of a large annotation file in memory, and takes long to import.
"""

import codecs
import re
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, is_typeddict

import msgspec

from skyproof.errors import SkyproofError, StoredFileError
from skyproof.files import refuse_special
from skyproof.ranges import WORDS, limits_of

T = TypeVar("T")

_WHOLE_LIMIT = 2**63
_LARGEST_BYTES = 4 * 2**30
_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "Path": "a path",
    "bytes": "bytes",
    # msgspec uses Python's names for values that do not become a path, and for some given ones.
    **dict.fromkeys(("array", "list", "tuple", "set"), "a list"),
    **dict.fromkeys(("object", "dict"), "an object"),
    **dict.fromkeys(("null", "NoneType"), "null"),
}


def read_document(
    path: Path,
    kind: type[T] | Any,
    remedy: str,
    *,
    version: int | None = None,
    error: type[SkyproofError] = StoredFileError,
) -> T:
    """Reads a JSON file as a value of a kind, and refuses everything else.

    Every number is finite, and whole numbers have at most 64 bits. A field that a dataclass does
    not know is refused at any depth, because it may be misspelt. A Struct decides for itself about
    unknown fields. The error is one sentence with the file, the place in it and the remedy, such as
    "copy the file again". With `version`, the field "format" must equal it; other versions are
    refused before their fields are read.
    """
    content = _content(path, remedy, error)
    if version is not None:
        found: _Versioned = parse_document(content, _Versioned, str(path), remedy, error=error)
        if found.format != version or isinstance(found.format, bool):
            raise error(
                f"{path} has format {str(found.format)[:40]}, but this version of skyproof reads "
                f"format {version}; {remedy}, or use the version that wrote it."
            )
    return parse_document(content, kind, str(path), remedy, error=error)


def read_lines(path: Path, kind: type[T] | Any, remedy: str) -> list[T]:
    """Reads a file of one JSON value per line, each as `read_document` reads a file."""
    lines = _content(path, remedy, StoredFileError).split(b"\n")
    return [
        parse_document(line, kind, f"{path} line {number}", remedy)
        for number, line in enumerate(lines, 1)
        if line.strip()
    ]


def parse_document(
    content: bytes,
    kind: type[T] | Any,
    place: str,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
) -> T:
    """Reads JSON text as `read_document` reads a file; `place` names it in errors."""

    struct = isinstance(kind, type) and issubclass(kind, msgspec.Struct)

    def parsed() -> T:
        if struct:
            return msgspec.json.decode(content, type=kind, dec_hook=_path_of_text)
        return _converted(msgspec.json.decode(content), kind)

    return _in_one_sentence(parsed, place, remedy, error)


def check_document(
    value: Any,
    kind: type[T] | Any,
    place: str,
    remedy: str,
    *,
    error: type[SkyproofError] = StoredFileError,
) -> T:
    """Checks plain values, such as a part of an open document, as `parse_document` checks text."""
    return _in_one_sentence(lambda: _converted(value, kind), place, remedy, error)


class _Versioned(msgspec.Struct):
    format: Any = None


def _converted(value: Any, kind: type[T] | Any) -> T:
    _refuse_strange(value, kind, "")
    return msgspec.convert(value, kind, dec_hook=_path_of_text)


def _path_of_text(kind: type, value: Any) -> Any:
    """Makes a path, the one type unknown to msgspec, which refuses any other result."""
    return Path(value) if kind is Path and isinstance(value, str) else value


def _in_one_sentence(
    read: Callable[[], T], place: str, remedy: str, error: type[SkyproofError]
) -> T:
    try:
        return read()
    except RecursionError:
        said = "is nested too deep"
    except _Strange as strange:
        said = str(strange)
    except SkyproofError as unfit:
        said = f"does not hold together: {str(unfit).rstrip('.')}"
    except msgspec.ValidationError as unfit:
        said = in_words(str(unfit))
    except (msgspec.DecodeError, UnicodeDecodeError) as damaged:
        said = f"is not JSON ({' '.join(str(damaged).split()).rstrip('.')[:200]})"
    raise error(f"{place}{'' if said.startswith(',') else ' '}{said}; {remedy}.") from None


class _Strange(Exception):
    """A value that msgspec accepts and we refuse."""


def _content(path: Path, remedy: str, error: type[SkyproofError]) -> bytes:
    refuse_special(path, remedy, error=error, largest_bytes=_LARGEST_BYTES)
    try:
        # Editors on Windows begin a text with a mark of its byte order.
        return Path(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}.") from None
    except (OSError, ValueError) as unreadable:
        reason = getattr(unreadable, "strerror", None) or str(unreadable)
        raise error(f"{path} cannot be read ({reason}); {remedy}.") from unreadable


def _refuse_strange(value: Any, hint: Any, place: str) -> None:
    """Refuses fields that a dataclass does not know, and whole numbers of more than 64 bits."""
    if isinstance(value, bool):
        return
    if isinstance(value, int) and not -_WHOLE_LIMIT <= value < _WHOLE_LIMIT:
        raise _Strange(f"{_at(place)}expected a whole number of at most 64 bits, got a larger one")
    if isinstance(value, Mapping):
        known = _fields_of(hint)
        if known is not None:
            for name in value:
                if name not in known:
                    raise _Strange(
                        f"{_at(place)}there is no field {str(name)[:60]!r} "
                        f"(known: {', '.join(known)})"
                    )
        for name, below in value.items():
            inner = known[name] if known is not None else _part_of(hint, -1)
            _refuse_strange(below, inner, f"{place}.{name}" if place else str(name))
    elif isinstance(value, list):
        for index, below in enumerate(value):
            _refuse_strange(below, _part_of(hint, index), f"{place}[{index}]")


def _fields_of(hint: Any) -> Mapping[str, Any] | None:
    """Returns the annotations of a dataclass, or of the one dataclass among several types."""
    if isinstance(hint, type) and (is_dataclass(hint) or is_typeddict(hint)):
        return limits_of(hint)
    parts = map(_fields_of, get_args(hint)) if _is_union(hint) else ()
    return next((known for known in parts if known is not None), None)


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, UnionType)


def _part_of(hint: Any, index: int) -> Any:
    """Returns the annotation of a list's items, or of an object's values."""
    parts = [part for part in get_args(hint) if part is not type(None)]
    if not parts:
        return None
    if _is_union(hint):
        return _part_of(parts[0], index)
    if get_origin(hint) is tuple and parts[-1] is not Ellipsis:
        return parts[index] if index < len(parts) else None
    # An object's values come last; a list, and a tuple of any length, has one kind of item.
    return parts[-1] if index < 0 else parts[0]


def _at(place: str) -> str:
    return f", {place}: " if place else "cannot be used: "


def in_words(message: str) -> str:
    """Turns "Expected `float`, got `str` - at `$.a.b`" into ", a.b: expected a number, ..."."""
    said, _, where = message.partition(" - at ")
    of_name = where.startswith("`key` in ")
    place = where.removeprefix("`key` in ").strip("`").removeprefix("$").removeprefix(".")
    said = re.sub(r"^Object missing required field `(.*)`$", r"the field \1 is missing", said)
    said = re.sub(r"^Invalid enum value (.*)$", r"\1 is none of the known values", said)
    said = re.sub(r"`(\w+(?: \| \w+)*)`", _kinds_in_words, said)
    for pattern, words in WORDS.items():
        said = said.replace(f"text matching regex {pattern!r}", words)
    said = re.sub(r"text matching regex .*", "text of another form", said)
    said = said[:1].lower() + said[1:300]
    return _at(place) + ("a field's name: " if of_name else "") + said


def _kinds_in_words(named: re.Match[str]) -> str:
    """Returns the kinds of a union, such as `int | null`, in words."""
    return " or ".join(_TYPES.get(kind, "another kind") for kind in named[1].split(" | "))
