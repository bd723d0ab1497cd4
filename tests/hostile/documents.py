"""The three tests that every kind of JSON document passes through."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tests.hostile.sandbox import Kind, Sandbox
from tests.hostile.values import any_json, damaged, examples, mutated, mutated_lines, serialised


def try_any_json(sandbox: Sandbox, kind: Kind, count: int) -> None:
    """Any JSON value in a document's place."""
    values = st.lists(any_json(), max_size=3) if kind.lines else any_json()
    _try(sandbox, kind, values.map(lambda value: _written(sandbox, kind, value)), count)


def try_mutations(sandbox: Sandbox, kind: Kind, count: int) -> None:
    """The valid document with one mutation."""
    content = (sandbox.inputs / kind.document).read_bytes()
    if kind.lines:
        changed = mutated_lines([json.loads(line) for line in content.splitlines()])
    else:
        changed = mutated(json.loads(content))
    _try(sandbox, kind, changed.map(lambda value: _written(sandbox, kind, value)), count)


def try_damage(sandbox: Sandbox, kind: Kind, count: int) -> None:
    """The valid document cut off, or with bytes changed."""
    content = (sandbox.inputs / kind.document).read_bytes()
    _try(sandbox, kind, damaged(content), count)


def try_contents(
    sandbox: Sandbox, kind: Kind, contents: st.SearchStrategy[bytes], count: int
) -> None:
    """Contents of any other form."""
    _try(sandbox, kind, contents, count)


def _written(sandbox: Sandbox, kind: Kind, value: Any) -> bytes:
    return serialised(value, lines=kind.lines, victim=str(sandbox.victim))


def _try(sandbox: Sandbox, kind: Kind, contents: st.SearchStrategy[bytes], count: int) -> None:
    @examples(count // 4 if kind.slow else count)
    @given(contents)
    def run(content: bytes) -> None:
        sandbox.try_document(kind, content)

    check: Callable[[], None] = run
    check()
