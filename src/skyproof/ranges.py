"""Ranges of numbers, forms of names and file references: annotations of fields, checked in one way.

Settings and stored documents use the same annotations: `check_ranges` checks settings,
`skyproof.documents` checks files. Imports no torch.
"""

import re
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

import msgspec
from msgspec import Meta

from skyproof.errors import ConfigurationError

Count = Annotated[int, Meta(ge=1, le=1_000_000)]
"""A number of things, at least one."""

WholeNumber = Annotated[int, Meta(ge=0, le=1_000_000)]
"""A number of things, perhaps none."""

_SIGNED_64_BITS = (-(2**63), 2**63 - 1)

Seed = Annotated[int, Meta(ge=_SIGNED_64_BITS[0], le=_SIGNED_64_BITS[1])]
"""Any whole number of 64 bits."""

Fraction = Annotated[float, Meta(ge=0, le=1)]
"""A share of a whole."""

Risk = Annotated[float, Meta(ge=1e-6, le=0.5)]
"""The accepted chance of a wrong answer."""

Match = Literal["centre_1m", "iou_50", "centre_in_box"]
"""A rule by which a detection matches a vehicle; see `match_detections`."""

Metres = Annotated[float, Meta(ge=0, le=1e6)]
"""A length."""

GroundResolution = Annotated[float, Meta(ge=0.001, le=100)]
"""Metres per pixel; below a millimetre one vehicle alone would fill the memory."""

ImageSide = Annotated[int, Meta(ge=1, le=16_384)]
"""Width or height of an image in pixels."""

Coordinate = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""A place in an image or a scene, in pixels or metres."""

Radians = Annotated[float, Meta(ge=-1e3, le=1e3)]
"""An angle."""

# On some systems separators, drives and control characters mean something in a file name.
_FORBIDDEN = r"\x00-\x1f\x7f/\\:"
_PART = rf"(?!\.+(?:/|\Z))[^{_FORBIDDEN}]{{1,150}}"
_NAME = rf"\A{_PART}\Z"
_REFERENCE = rf"\A{_PART}(?:/{_PART}){{0,7}}\Z"

Name = Annotated[str, Meta(pattern=_NAME)]
"""A future file or folder name: no separators, no dots alone, at most 150 characters."""

FileReference = Annotated[str, Meta(pattern=_REFERENCE)]
"""A file below the folder of the document that names it: relative, without "..", with "/"."""

WORDS = {
    _NAME: "a plain name (at most 150 characters, no separators, not dots alone)",
    _REFERENCE: "a file inside the same folder (a relative path without '..')",
}
"""The requirement of each pattern, in words for a message."""


def is_name(text: str) -> bool:
    """Whether a text can be a file's name, as `Name` requires."""
    return re.search(_NAME, text) is not None


class Checked:
    """A dataclass of this base checks its fields against their limits when it is made."""

    def __post_init__(self) -> None:
        check_ranges(self)


def check_ranges(settings: object) -> None:
    """Checks the fields of a dataclass against the limits in their annotations.

    Nested settings check themselves, except typed dictionaries, which are checked here.
    """
    kind: Any = type(settings)
    for name, hint in _limited(kind).items():
        value = getattr(settings, name)
        if not is_typeddict(hint):
            check_value(name, value, hint)
            continue
        known = limits_of(hint)
        for changed, inner in value.items():
            check_value(changed, inner, known[changed])


def check_value(name: str, value: Any, hint: Any) -> None:
    """Checks a number, a text, or a tuple of such against an annotation with limits."""
    try:
        msgspec.convert(_plain(value), hint)
    except msgspec.ValidationError as error:
        raise ConfigurationError(
            f"{name} expects {_expected(hint)}, got {_shown(value)}."
        ) from error


@cache
def limits_of(kind: type) -> Mapping[str, Any]:
    """Returns the annotations of a dataclass or typed dictionary, limits included, by field."""
    return get_type_hints(kind, include_extras=True)


@cache
def _limited(kind: type) -> Mapping[str, Any]:
    """Returns the annotations with a limit or a choice, by field."""
    hints = limits_of(kind)
    named = {field.name: hints[field.name] for field in fields(kind)}
    return {
        name: hint
        for name, hint in named.items()
        if is_typeddict(hint) or _choices(hint) or any(_metas(hint))
    }


def _choices(hint: Any) -> list[str]:
    """Returns the choices of an annotation; empty if it is no choice."""
    if get_origin(hint) is Literal:
        return [str(choice) for choice in get_args(hint)]
    return [choice for part in get_args(hint) for choice in _choices(part)]


def _metas(hint: Any) -> list[tuple[Any, Meta]]:
    """Returns the limits anywhere in an annotation, each with the type it is for."""
    if hasattr(hint, "__metadata__"):
        own = [(hint.__origin__, meta) for meta in hint.__metadata__ if isinstance(meta, Meta)]
        return own + _metas(hint.__origin__)
    return [pair for part in get_args(hint) for pair in _metas(part)]


def _expected(hint: Any) -> str:
    """Describes the values that an annotation allows."""
    kinds = {int: "a whole number", float: "a number", str: "text"}
    choices = _choices(hint)
    words = [f"one of {', '.join(choices)}"] if len(choices) > 1 else choices
    length = ""
    for kind, meta in _metas(hint):
        if meta.max_length is not None and kind is not str:
            least = "at most " if meta.min_length is None else f"{meta.min_length:,} to "
            length = f"{least}{meta.max_length:,} "
        elif meta.max_length is not None:
            words.append(f"text of at most {meta.max_length:,} characters")
        elif meta.pattern is not None:
            words.append(WORDS.get(meta.pattern, "text of another form"))
        elif (meta.ge, meta.le) == _SIGNED_64_BITS:
            words.append("a whole number of at most 64 bits")
        else:
            below = "below" if meta.ge is None and meta.gt is None else "to below"
            bounds = [("from", meta.ge), ("above", meta.gt), ("up to", meta.le), (below, meta.lt)]
            limits = [f"{word} {_number(bound)}" for word, bound in bounds if bound is not None]
            words.append(" ".join([kinds.get(kind, "a value"), *limits]))
    bare = hint.__origin__ if hasattr(hint, "__metadata__") else hint
    listed = f"{length}values, each " if get_origin(bare) in (tuple, list) else ""
    return f"{listed}{' or '.join(dict.fromkeys(words))}"


def _shown(value: Any) -> str:
    """Returns the beginning of a value; Python does not print whole numbers of any length."""
    try:
        text = repr(value)
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:100]}..."


def _number(bound: int | float) -> str:
    return f"{bound:,}" if isinstance(bound, int) else f"{bound:g}"


def _plain(value: Any) -> Any:
    """Returns a value as Python's own type: NumPy's and torch's numbers have `item`."""
    if isinstance(value, tuple | list):
        return tuple(map(_plain, value))
    return value.item() if hasattr(value, "item") else value
