"""A command's settings as the words of a command line, so that any step can be done by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any


def command_words(name: str, command: Any) -> list[str]:
    """Returns `skyproof`'s arguments that stand for a command's settings.

    Settings that have their default are left out; positional ones come first.

    Args:
        name: the command's.
        command: its settings, a dataclass; nested settings become --outer.inner.
    """
    positional: list[str] = []
    options: list[str] = []
    for field in fields(command):
        value = getattr(command, field.name)
        default = _default(field)
        if value == default:
            continue
        if "Positional" in str(field.type):
            positional += _texts(value)
        else:
            options += _options(field.name, value, default)
    return [name, *positional, *options]


def _options(name: str, value: Any, default: Any) -> Iterator[str]:
    flag = name.replace("_", "-")
    if is_dataclass(value) or isinstance(value, dict):
        usual = _nested(default)
        for inner_name, inner in _nested(value).items():
            if inner != usual.get(inner_name, MISSING):
                yield from _options(f"{name}.{inner_name}", inner, usual.get(inner_name))
    elif isinstance(value, bool):
        outer, _, last = flag.rpartition(".")
        yield f"--{flag}" if value else f"--{outer}{'.' if outer else ''}no-{last}"
    else:
        yield f"--{flag}"
        yield from _texts(value)


def _nested(settings: Any) -> dict[str, Any]:
    """Nested settings by name: of a dataclass all, of a dictionary those that it holds."""
    return settings if isinstance(settings, dict) else vars(settings)


def _default(field: Field[Any]) -> Any:
    """What a command takes where nothing is said; MISSING where something must be."""
    if field.default_factory is not MISSING:
        return field.default_factory()
    return field.default


def _texts(value: Any) -> list[str]:
    return [str(part) for part in value] if isinstance(value, tuple) else [str(value)]
