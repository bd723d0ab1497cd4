"""Files of tensors: damaged bytes, records and numbers that are not finite."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from safetensors.numpy import load, save

from tests.hostile.documents import try_contents, try_damage
from tests.hostile.kinds import compare, learnt, mix, worn
from tests.hostile.sandbox import Kind, Sandbox
from tests.hostile.values import mutated, serialised

KINDS = [
    Kind("tensors of a fleet", "fleets/test/fleet.safetensors", mix),
    Kind("tensors of a camouflage", "camouflages/R-U-0/camouflage.safetensors", worn),
    Kind("tensors of a generator", "learnt/generator.safetensors", learnt),
    Kind("weights of a detector", "detectors/retinanet/weights.safetensors", compare),
]

pytestmark = [pytest.mark.slow, pytest.mark.parametrize("kind", KINDS, ids=str)]


def with_header(content: bytes, header: bytes) -> bytes:
    """The same numbers under another header."""
    (length,) = struct.unpack("<Q", content[:8])
    return struct.pack("<Q", len(header)) + header + content[8 + length :]


def header_of(content: bytes) -> Any:
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length])


def changed(content: bytes) -> st.SearchStrategy[bytes]:
    """Tensors with other numbers, types and shapes, one left out or one too many."""
    tensors = load(content)

    def made(drawn: tuple[str, str]) -> bytes:
        name, what = drawn
        others = dict(tensors)
        array = others.pop(name)
        flat = array.copy().reshape(-1)
        if what in ("nan", "inf", "1e30", "-1") and array.dtype.kind == "f":
            flat[flat.size // 2] = float(what)
            others[name] = flat.reshape(array.shape)
        elif what == "whole":
            others[name] = np.zeros(array.shape, dtype=np.int64)
        elif what == "wide":
            others[name] = array.astype(np.float64) * math.pi
        elif what == "flat":
            others[name] = flat
        elif what == "empty":
            others[name] = flat[:0]
        elif what == "half":
            others[name] = array[: len(array) // 2].copy() if array.ndim else array
        elif what == "twice":
            others[name] = array
            others["../../x"] = array
        return save(others)

    ways = ["nan", "inf", "1e30", "-1", "whole", "wide", "flat", "empty", "half", "twice", "none"]
    return st.tuples(st.sampled_from(sorted(tensors)), st.sampled_from(ways)).map(made)


def test_damaged_bytes(sandbox: Sandbox, kind: Kind) -> None:
    try_damage(sandbox, kind, 15)


def test_one_mutation_of_the_header(sandbox: Sandbox, kind: Kind) -> None:
    content = (sandbox.inputs / kind.document).read_bytes()
    header = header_of(content)
    few = dict(list(header.items())[:6])
    rest = {name: value for name, value in header.items() if name not in few}

    def whole(part: Any) -> bytes:
        joined = {**part, **rest} if isinstance(part, dict) else part
        return with_header(content, serialised(joined, victim=str(sandbox.victim)))

    try_contents(sandbox, kind, mutated(few).map(whole), 30)


def test_other_tensors(sandbox: Sandbox, kind: Kind) -> None:
    content = (sandbox.inputs / kind.document).read_bytes()
    try_contents(sandbox, kind, changed(content), 30)
