"""Hostile documents: any JSON, a valid document with one mutation, damaged bytes."""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Iterator
from typing import Any

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

__all__ = [
    "HOSTILE",
    "NUMBERS",
    "any_json",
    "damaged",
    "examples",
    "mutated",
    "mutated_lines",
    "mutated_text",
    "serialised",
]

MORE = int(os.environ.get("SKYPROOF_EXAMPLES", "1"))
"""How many times as many examples as usual; beyond 1 they are drawn anew in every run."""


def examples(count: int) -> Any:
    """Settings of a property test with so many examples."""
    return settings(
        max_examples=count * MORE,
        derandomize=MORE == 1,
        database=None,
        deadline=None,
        # One mutation of a valid document is as small as a failure gets.
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )


# JSON cannot be written with these through Python; the text takes their place afterwards.
_RAW = {
    "@NaN@": "NaN",
    "@infinity@": "Infinity",
    "@overflow@": "1e999",
    "@5000 digits@": "9" * 5000,
    "@-5000 digits@": "-" + "9" * 5000,
    "@deep list@": "[" * 100_000 + "]" * 100_000,
    "@deep object@": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "@half a surrogate@": '"\\ud800"',
    "@no value@": "",
}

HOSTILE: list[Any] = [
    *_RAW,
    *(None, True, False, 0, -1, 1, 2, 7, 2**31, 2**63, -(2**63) - 1, 10**30),
    *(0.5, -0.0, 5e-324, 1e-9, 1e300, -1e300, 3.7),
    *("", " ", ".", "..", "a\0b", "a\nb", "\x1b[2J", "\u202egnp", "x" * 5000, "é" * 150),
    *("../../../x", "/etc/passwd", "@victim@", "../../../../victim/holiday.png", "a/../../b"),
    *("<script>alert(1)</script>", "{{7*7}}", "$(touch x)", "NaN", "1e999", "CON", "C:\\a"),
    *([], {}, [[]], [None], [0.0] * 1000, {"a": 1}, [1, "a", None]),
]

NUMBERS = ["nan", "inf", "-inf", "1e300", "-1e300", "1e-300", "1e999", "-1", "0", "0.5", "1", "2"]
NUMBERS += [str(2**63), str(2**63 - 1), str(-(2**63)), str(10**30), "9" * 4000, "9" * 5000]
NUMBERS += ["-0.0", "1e9", "1_0", "0x10", "", "None", "true"]


def any_json() -> st.SearchStrategy[Any]:
    """Any JSON value, hostile ones among its leaves."""
    leaves = (
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.text(max_size=20)
        | st.sampled_from(HOSTILE)
    )
    keys = st.text(max_size=8) | st.sampled_from(["id", "images", "tiles", "rows", "format", "a"])
    return st.recursive(
        leaves,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
        max_leaves=12,
    )


def mutated(document: Any) -> st.SearchStrategy[Any]:
    """A valid document with one mutation anywhere in it."""
    places = list(_places(document))
    keyed = [place for place in places if place and isinstance(place[-1], str)]
    objects = [place for place in places if isinstance(_at(document, place), dict)]
    rows = [place for place in places if place and isinstance(place[-1], int)]
    changes = [
        st.tuples(st.just("replace"), st.sampled_from(places), st.sampled_from(HOSTILE)),
        st.tuples(st.just("replace"), st.sampled_from(places), any_json()),
    ]
    if keyed:
        changes.append(st.tuples(st.just("delete"), st.sampled_from(keyed), st.none()))
    if objects:
        added = st.sampled_from(HOSTILE)
        changes.append(st.tuples(st.just("add"), st.sampled_from(objects), added))
    if rows:
        changes.append(st.tuples(st.just("double"), st.sampled_from(rows), st.none()))
        changes.append(st.tuples(st.just("remove"), st.sampled_from(rows), st.none()))
    # Replacing is the most telling of them.
    return st.one_of(changes[0], *changes).map(lambda change: _changed(document, *change))


def mutated_lines(rows: list[Any]) -> st.SearchStrategy[Any]:
    """As `mutated`, for a file of one JSON value a line."""
    return mutated(rows).filter(lambda changed: isinstance(changed, list))


def serialised(document: Any, *, lines: bool = False, victim: str = "/etc/hosts") -> bytes:
    """Writes a document, hostile values as the text that they stand for."""
    if lines and isinstance(document, list):
        return b"\n".join(serialised(row, victim=victim) for row in document) + b"\n"
    text = json.dumps(document).replace("@victim@", victim)
    for name, raw in _RAW.items():
        text = text.replace(f'"{name}"', raw)
    return text.encode()


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """A file cut off, with bytes flipped, inserted or taken out."""
    place = st.integers(0, max(len(content) - 1, 0))
    byte = st.integers(0, 255)
    return st.one_of(
        place.map(lambda at: content[:at]),
        st.tuples(place, byte).map(
            lambda flip: content[: flip[0]] + bytes([flip[1]]) + content[flip[0] + 1 :]
        ),
        st.tuples(place, st.binary(min_size=1, max_size=8)).map(
            lambda put: content[: put[0]] + put[1] + content[put[0] :]
        ),
        st.tuples(place, st.integers(1, 40)).map(
            lambda cut: content[: cut[0]] + content[cut[0] + cut[1] :]
        ),
        st.sampled_from([b"", b"\xff\xfe", bytes(4096), b"\xef\xbb\xbf" + content]),
        st.binary(max_size=200),
    )


_WORDS = [*NUMBERS, "..", "../../../x", "/etc/passwd", "a\0b", "x" * 5000, "\x1b[2J", "#", ":", "-"]
_WORDS += ["[", "{", "]", "&a", "*a", "!!python/object/apply:os.system ['touch x']", "\t", "'"]


def mutated_text(text: str) -> st.SearchStrategy[bytes]:
    """A text file with one word or line replaced, doubled or taken out."""
    lines = text.splitlines()
    number = st.integers(0, len(lines) - 1)
    word = st.integers(0, 20)

    def with_word(drawn: tuple[int, int, str]) -> str:
        words = lines[drawn[0]].split(" ")
        words[drawn[1] % len(words)] = drawn[2]
        return "\n".join([*lines[: drawn[0]], " ".join(words), *lines[drawn[0] + 1 :]])

    def with_line(drawn: tuple[int, str]) -> str:
        return "\n".join([*lines[: drawn[0]], drawn[1], *lines[drawn[0] + 1 :]])

    return st.one_of(
        st.tuples(number, word, st.sampled_from(_WORDS)).map(with_word),
        st.tuples(number, st.sampled_from(_WORDS) | st.text(max_size=30)).map(with_line),
        number.map(lambda at: "\n".join([*lines, lines[at]])),
    ).map(lambda changed: changed.encode(errors="surrogatepass"))


def _places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield place
    if isinstance(value, dict):
        for key, below in value.items():
            yield from _places(below, (*place, key))
    elif isinstance(value, list):
        # Later rows are like the first ones.
        for index, below in enumerate(value[:4]):
            yield from _places(below, (*place, index))


def _at(document: Any, place: tuple[Any, ...]) -> Any:
    for key in place:
        document = document[key]
    return document


def _changed(document: Any, what: str, place: tuple[Any, ...], value: Any) -> Any:
    if not place and what == "replace":
        return value
    changed = copy.deepcopy(document)
    if what == "add":
        _at(changed, place)["a field that nobody knows"] = value
        return changed
    above = _at(changed, place[:-1])
    key = place[-1]
    if what == "replace":
        above[key] = value
    elif what == "double":
        above.append(copy.deepcopy(above[key]))
    else:
        del above[key]
    return changed


def finite(value: Any) -> bool:
    """Says whether every number of a value read from JSON is finite."""
    if isinstance(value, dict):
        return all(map(finite, value.values()))
    if isinstance(value, list):
        return all(map(finite, value))
    return not isinstance(value, float) or math.isfinite(value)
