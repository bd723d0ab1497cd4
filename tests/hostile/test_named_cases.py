"""What once went wrong, case by case: each ends in one sentence, and everything else stays."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.hostile import kinds
from tests.hostile.sandbox import RAN, Kind, Sandbox
from tests.hostile.values import serialised

DEEP, DIGITS, OVERFLOW = "@deep list@", "@5000 digits@", "@overflow@"

KINDS = {
    "scenes": kinds.SCENES[0],
    "index": kinds.GROUND[0],
    "index of tiles": kinds.GROUND[2],
    "annotations": kinds.DATASETS[0],
    "annotations as YOLO": kinds.DATASETS[1],
    "palette": kinds.CARDS[2],
    "COCO labels": kinds.LABELS[0],
}

CASES: list[tuple[str, tuple[Any, ...], Any]] = [
    *(
        ("scenes", (0, "id"), name)
        for name in ("../../../victim/holiday", "@victim@", "a\0b", "..")
    ),
    ("scenes", (0, "id"), "x" * 5000),
    *(("scenes", (0, "seed"), seed) for seed in (2**63, DIGITS, 0.5, None)),
    *(("scenes", (1, "camera", "gsd_m"), value) for value in (0, -1, 1e300, OVERFLOW, "@NaN@")),
    *(("scenes", (1, "camera", "size_px"), value) for value in (0, -1, 2**31, 1e300, DEEP)),
    ("scenes", (0, "placements"), [{"vehicle": "a", "x_m": 1, "y_m": 2}] * 10),
    *(
        ("index of tiles", ("tiles", 0, "file"), name)
        for name in ("@victim@", "../../../x", "a\0b")
    ),
    *(("index", ("tiles", 0, "id"), name) for name in ("../../../x", "", ".", "a/b")),
    *(("index", ("gsd_m",), value) for value in (0, -0.1, 1e300, "@infinity@")),
    *(("index", ("tiles", 0, "width_px"), value) for value in (10**6, 0, -5, DIGITS)),
    *(("annotations as YOLO", ("images", 0, "file_name"), name) for name in ("@victim@", "..")),
    ("annotations as YOLO", ("images", 0, "file_name"), "../../../../../victim/holiday.png"),
    ("annotations", ("annotations", 0, "bbox"), [1, 2]),
    ("annotations", ("annotations", 0, "bbox", 0), 1e300),
    ("annotations", ("images", 0, "width"), 10**6),
    ("annotations as YOLO", ("images", 0, "scene_id"), "../../x"),
    ("palette", ("colours_srgb", 0, 0), 256),
    ("palette", ("colours_srgb",), [[1, 2, 3]]),
    ("COCO labels", ("annotations", 0, "bbox", 2), OVERFLOW),
    ("COCO labels", ("annotations", 0, "image_id"), {"a": 1}),
    ("COCO labels", ("images", 0, "file_name"), DEEP),
]


@pytest.mark.parametrize(("name", "place", "value"), CASES)
def test_document(sandbox: Sandbox, name: str, place: tuple[Any, ...], value: Any) -> None:
    kind = KINDS[name]
    content = (sandbox.inputs / kind.document).read_bytes()
    document = [json.loads(line) for line in content.splitlines()] if kind.lines else None
    document = document or json.loads(content)
    above = document
    for key in place[:-1]:
        above = above[key]
    above[place[-1]] = value
    hostile = serialised(document, lines=kind.lines, victim=str(sandbox.victim))
    assert sandbox.try_document(kind, hostile) == 2


def claiming(side_px: int) -> bytes:
    """A small PNG whose header claims a size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", side_px, side_px, 8, 2, 0, 0, 0)
    rows = chunk(b"IDAT", zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + rows + chunk(b"IEND", b"")


Words = Callable[[Path, Path], Sequence[object]]
PICTURES: list[tuple[str, Words]] = [
    ("backgrounds/tiles/test-00000.png", kinds.render),
    ("datasets/validation/images/validation-000000.png", kinds.score),
]


@pytest.mark.parametrize("side_px", [30_000, 10**6])
@pytest.mark.parametrize(("picture", "words"), PICTURES)
def test_a_picture_that_claims_too_much(
    sandbox: Sandbox, picture: str, words: Words, side_px: int
) -> None:
    kind = Kind("pictures", picture, words)
    assert sandbox.try_document(kind, claiming(side_px)) == 2


@pytest.mark.parametrize(
    "name", ["R-../../x", "R-U/../../x", "T-U\0", "/etc/passwd", "R-U-" + "9" * 5000]
)
def test_names_of_camouflages_stay_in_the_output(sandbox: Sandbox, name: str) -> None:
    sandbox.clear()
    answer = sandbox.call(["attack", name, "--out", sandbox.out / "new", *kinds.ON_CPU])
    assert answer.code == 2
    answer.assert_one_sentence()


OUTPUTS: dict[str, Words] = {
    "render": lambda inputs, out: [*kinds.render(inputs, out), "--out", out / "mine"],
    "ground": lambda inputs, out: [*kinds.cut(inputs, out), "--out", out / "mine"],
    "clear": lambda inputs, out: [*kinds.clear(inputs, out), "--out", out / "mine"],
    "vehicles": lambda inputs, out: [*kinds.mix(inputs, out)[:-1], out / "mine"],
    "score": lambda inputs, out: [*kinds.score(inputs, out), "--out", out / "mine"],
    "train": lambda inputs, out: [*kinds.train(inputs, out), "--out", out / "mine"],
    "attack": lambda inputs, out: ["attack", "R-U", "--out", out / "mine", *kinds.ON_CPU],
    "reproduce": lambda inputs, out: ["reproduce", "--out", out / "mine", "--cores", 1],
    "demo": lambda inputs, out: ["demo", "--out", out / "mine"],
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_exists_is_not_overwritten(sandbox: Sandbox, name: str) -> None:
    sandbox.clear()
    mine = sandbox.out / "mine"
    mine.write_text("precious")
    answer = sandbox.call(OUTPUTS[name](sandbox.inputs, sandbox.out))
    RAN["outputs"] += 1
    assert answer.code == 2, answer
    answer.assert_one_sentence()
    assert "mine" in answer.err
    assert mine.read_text() == "precious"
    assert [path.name for path in sandbox.out.iterdir()] == ["mine"]


def test_a_preset_cannot_name_options(sandbox: Sandbox) -> None:
    preset = json.loads((sandbox.inputs / "preset.json").read_text())
    for place in ("attack", "training", "world"):
        changed = json.loads(json.dumps(preset))
        within = changed[place]["yolov5"] if place == "training" else changed[place]
        within["steps; touch injected #"] = 1
        assert sandbox.try_document(kinds.PRESETS[0], json.dumps(changed).encode()) == 2
