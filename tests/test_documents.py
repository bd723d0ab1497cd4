"""One validated read: whatever is in a file, the value asked for or one sentence with the place."""

import json
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta

from skyproof.documents import check_document, parse_document, read_document, read_lines
from skyproof.errors import ConfigurationError, ImageryError, StoredFileError
from skyproof.ranges import Coordinate, Count, FileReference, Fraction, Name, Seed

Xs = Annotated[str, Meta(pattern="^x+$")]


@dataclass(frozen=True)
class Part:
    x_m: Coordinate
    count: Count = 1


@dataclass(frozen=True)
class Whole:
    name: Name
    parts: tuple[Part, ...]
    file: FileReference = "a.png"
    seed: Seed = 0
    kind: Literal["near", "far"] = "near"
    best: Part | None = None
    sorts: dict[str, Part] | None = None
    pair: tuple[Fraction, Fraction] = (0.0, 1.0)
    places: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.pair[0] > self.pair[1]:
            raise ConfigurationError("pair expects the smaller number first.")


class Foreign(msgspec.Struct):
    count: Count
    things: list[Part] = []
    place: Path | None = None


GOOD = {"name": "a", "parts": [{"x_m": 1.5}, {"x_m": -2, "count": 3}]}
DIGITS = "9" * 5000
DEEP = "[" * 100_000 + "]" * 100_000


def said(content: str | bytes, kind: Any = Whole) -> str:
    """The sentence about a document that is refused."""
    data = content.encode() if isinstance(content, str) else content
    with pytest.raises(StoredFileError) as caught:
        parse_document(data, kind, "scenes.jsonl line 7", "sample them again")
    message = str(caught.value)
    assert message.startswith("scenes.jsonl line 7")
    assert message.endswith("; sample them again.")
    assert "\n" not in message
    assert len(message) < 600
    # A chain of causes would be a library's words, not ours.
    assert caught.value.__suppress_context__
    return message


def changed(**fields: Any) -> str:
    return json.dumps({**GOOD, **fields})


def test_a_valid_document_is_the_dataclass_itself() -> None:
    whole = parse_document(json.dumps(GOOD).encode(), Whole, "a", "b")
    assert whole == Whole("a", (Part(1.5), Part(-2.0, 3)))
    everything = Whole("b", (), "c/d.png", -1, "far", Part(0.0), {"e": Part(1.0)}, (0.25, 0.5))
    assert parse_document(json.dumps(asdict(everything)).encode(), Whole, "a", "b") == everything


def test_text_becomes_a_path_where_one_is_asked_for() -> None:
    values = {**GOOD, "places": ["a.tif", "/b c/d.tif"]}
    places = (Path("a.tif"), Path("/b c/d.tif"))
    for whole in (
        parse_document(json.dumps(values).encode(), Whole, "a", "b"),
        check_document(values, Whole, "a", "b"),
    ):
        assert whole.places == places
    foreign = parse_document(b'{"count": 1, "place": "a.tif"}', Foreign, "a", "b")
    assert foreign.place == Path("a.tif")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (changed(parts=[{"x_m": 1}, {"x_m": "far"}]), ", parts[1].x_m: expected a number, got tex"),
        (changed(parts=[{"x_m": 1e300}]), ", parts[0].x_m: expected a number <="),
        (changed(parts=[{"x_m": float("nan")}]), " is not JSON ("),
        (changed(parts=[{"x_m": float("inf")}]), " is not JSON ("),
        ('{"name": "a", "parts": [{"x_m": 1e999}]}', ": number out of range"),
        (changed(parts=[{"x_m": True}]), "expected a number, got true or false"),
        (changed(parts=[{"count": 1}]), ", parts[0]: the field x_m is missing"),
        (changed(parts=[{"x_m": 1, "y_m": 2}]), ", parts[0]: there is no field 'y_m' (known: x_m"),
        (changed(best={"x_m": 1, "y_m": 2}), ", best: there is no field 'y_m'"),
        (changed(sorts={"e": {"x_m": 1, "y_m": 2}}), ", sorts.e: there is no field 'y_m'"),
        (changed(best=7), ", best: expected an object or null, got a whole number"),
        (changed(extra=1), "there is no field 'extra'"),
        (changed(name="../../../victim/holiday"), ", name: expected a plain name"),
        (changed(name="a\0b"), ", name: expected a plain name"),
        (changed(name=".."), ", name: expected a plain name"),
        (changed(name="x" * 10**6), ", name: expected a plain name"),
        (changed(file="/etc/passwd"), ", file: expected a file inside the same folder"),
        (changed(file="a/../../b"), ", file: expected a file inside the same folder"),
        (changed(kind="middle"), ", kind: 'middle' is none of the known values"),
        (changed(seed=2**63), ", seed: expected a whole number of at most 64 bits"),
        (changed(extra=2**70), "there is no field 'extra'"),
        (changed(seed=1.5), ", seed: expected a whole number"),
        (changed(pair=[0.5]), ", pair: expected a list of length 2"),
        (changed(places=["a", 3]), ", places[1]: expected a path, got a whole number"),
        (changed(places=[["a"]]), ", places[0]: expected a path, got a list"),
        (changed(places=[None]), ", places[0]: expected a path, got null"),
        (changed(places="a"), ", places: expected a list, got text"),
        (changed(pair=[1, 0]), "pair expects the smaller number first"),
        (f'{{"name": "a", "parts": [], "seed": {DIGITS}}}', "integer value out of range"),
        (f'{{"name": "a", "parts": {DEEP}}}', " is nested too deep"),
        (DEEP, " is nested too deep"),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, " is nested too deep"),
        ("[" * 100_000, " is nested too deep"),
        ("[]", "expected an object, got a list"),
        ("null", "expected an object, got null"),
        ("", " is not JSON"),
        ("{", " is not JSON"),
        (b"\xff\xfe{", " is not JSON"),
        (b'{"name": "\xed\xa0\x80"}', " is not JSON"),
        ('{"name": "\\ud800"}', " is not JSON"),
        (json.dumps(GOOD) + " trailing", " is not JSON"),
        (b"\x00" * 1000, " is not JSON"),
    ],
)
def test_one_sentence_with_the_place(content: str | bytes, words: str) -> None:
    assert words in said(content)


@pytest.mark.parametrize(
    ("value", "kind", "words"),
    [
        ("x", int | list[int] | None, "expected a whole number or a list or null, got text"),
        (3, dict[Xs, int] | None, "an object or null, got a"),
        (
            {"y": 1},
            dict[Xs, int],
            "a field's name: expected text",
        ),
        (
            {"a": {1: 2}},
            dict[str, dict[str, int]],
            "a field's name: expected text, got",
        ),
        ("y", Xs, "expected text of another form;"),
        (b"x", int, "expected a whole number, got bytes"),
        ({1}, int, "expected a whole number, got a list"),
        ("y" * 10**6, Literal["x"], "'yyyy"),
    ],
)
def test_a_sentence_holds_no_pattern_and_no_type_of_python(
    value: Any, kind: Any, words: str
) -> None:
    with pytest.raises(StoredFileError) as caught:
        check_document(value, kind, "file", "replace it")
    assert words in str(caught.value)
    assert len(str(caught.value)) < 400
    for sign in ("`", "^", "regex", "|", "NoneType", "enum"):
        assert sign not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"count": 0}', ", count: expected a whole number >= 1"),
        ('{"count": 1, "things": [{"x_m": 1e999}]}', "number out of range"),
        ('{"count": 1, "things": [{}]}', ", things[0]: the field x_m is missing"),
        ('{"count": 1, "place": {}}', ", place: expected a path, got an object"),
        (f'{{"count": {DIGITS}}}', "integer value out of range"),
        (f'{{"count": 1, "rest": {DEEP}}}', "nested too deep"),
        ("[]", "expected an object, got a list"),
    ],
)
def test_foreign_formats_skip_what_nobody_asks_for(content: str, words: str) -> None:
    assert words in said(content, Foreign)
    kept = parse_document(b'{"count": 1, "rest": {"deep": [1e308]}}', Foreign, "a", "b")
    assert kept.count == 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)
OPTIONAL = ("name", "parts", "file", "seed", "kind", "best", "sorts", "pair")
FIELDS = st.fixed_dictionaries({}, optional=dict.fromkeys(OPTIONAL, JSON))


@settings(derandomize=True, max_examples=300, deadline=None)
@given(JSON | FIELDS | FIELDS.map(lambda some: {**GOOD, **some}) | st.binary())
def test_any_json_is_the_kind_or_one_sentence(value: Any) -> None:
    data = value if isinstance(value, bytes) else json.dumps(value).encode()
    for kind in (Whole, Foreign, list[Part], dict[str, Any], Any):
        try:
            read = parse_document(data, kind, "a.json", "make it again")
        except StoredFileError:
            continue
        assert not is_dataclass(kind) or isinstance(read, kind)
        # Every number is finite: what is read can be stored.
        json.dumps(msgspec.to_builtins(read), allow_nan=False)


def test_files_are_named_as_the_user_gave_them(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.json").write_text(json.dumps(GOOD))
    assert read_document(Path("a.json"), Whole, "make it again").name == "a"
    for path, words in (("none.json", "is missing"), (".", "cannot be read (Is a directory)")):
        with pytest.raises(ImageryError) as caught:
            read_document(Path(path), Whole, "make it again", error=ImageryError)
        assert str(caught.value) == f"{path} {words}; make it again."
    for path in ("a\0b", "x" * 300):
        with pytest.raises(StoredFileError, match="cannot be read"):
            read_document(Path(path), Whole, "make it again")


def test_lines_are_told_by_number(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text('{"x_m": 1}\n\n{"x_m": 2, "count": 2}\n')
    assert read_lines(path, Part, "make it again") == [Part(1.0), Part(2.0, 2)]
    # A separator that Python takes for the end of a line, and JSON does not.
    path.write_text('{"name": "a\u2028b", "parts": []}\n')
    assert read_lines(path, Whole, "make it again")[0].name == "a\u2028b"
    path.write_text('{"x_m": 1}\n\n{"x_m": "2"}\n')
    with pytest.raises(StoredFileError) as caught:
        read_lines(path, Part, "make it again")
    assert str(caught.value) == (f"{path} line 3, x_m: expected a number, got text; make it again.")
    path.write_text("")
    assert read_lines(path, Part, "make it again") == []
