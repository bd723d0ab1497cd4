"""Any number for any option of any command: done, or one refusal before anything is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints, is_typeddict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyproof.main import COMMANDS, load_command
from tests.hostile import kinds
from tests.hostile.sandbox import RAN, Sandbox
from tests.hostile.values import NUMBERS, examples

pytestmark = pytest.mark.slow

NAMES = [name for group in COMMANDS.values() for name in group]


def numeric_options(kind: Any, prefix: str = "") -> Iterator[tuple[str, int | None]]:
    """The options of a command that take numbers, and how many; None: any number of them."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if name.startswith("_"):
            continue
        option = f"{prefix}{name.replace('_', '-')}"
        plain = _plain(hint)
        if dataclasses.is_dataclass(plain) or is_typeddict(plain):
            yield from numeric_options(plain, f"{option}.")
        elif plain in (int, float):
            yield option, 1
        elif get_origin(plain) is tuple and _plain(get_args(plain)[0]) in (int, float):
            parts = get_args(plain)
            yield option, None if parts[-1] is Ellipsis else len(parts)


def _plain(hint: Any) -> Any:
    """An annotation without limits and without None."""
    if get_origin(hint) is Annotated:
        return _plain(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        parts = [part for part in get_args(hint) if part is not type(None)]
        return _plain(parts[0]) if len(parts) == 1 else None
    origin = get_origin(hint)
    if origin is not None and getattr(origin, "__name__", "") in ("NotRequired", "Required"):
        return _plain(get_args(hint)[0])
    return hint


def base(name: str, inputs: Path, out: Path) -> Sequence[object]:
    """A small call of a command."""
    detector = inputs / "detectors/retinanet"
    imported = ["--vehicle-classes", "3", "--validation", inputs / "datasets/test"]
    imported += ["--out", out / "new"]
    checked = ["precheck", detector, "--backgrounds", inputs / "nowhere"]
    calls: dict[str, Sequence[object]] = {
        "demo": ["demo", "--out", out / "new", "--device", "nowhere"],
        "assess": ["assess", detector, "--out", out / "new", "--imagery", inputs / "nowhere.tif"],
        "reproduce": ["reproduce", "--preset", inputs / "nowhere.json", "--out", out / "new"],
        "report": ["report", inputs / "nowhere"],
        "ground": ["ground", "--out", out / "new", "--tiles", 1, 1, 1, 1, "--tiling.size-px", 24],
        "clear": kinds.clear(inputs, out),
        "vehicles": ["vehicles", "--out", out / "new", "--counts", 1, 1, 1, 1],
        "harden": ["harden", inputs / "nowhere", "--out", out / "new"],
        "render": kinds.render(inputs, out),
        "train": kinds.train(inputs, out),
        "precheck": [*checked, "--fleet", inputs / "nowhere"],
        "import": ["import", inputs / "palette.json", "--kind", "torchvision", *imported],
        "attack": ["attack", "R-PixFc", "--palette", inputs / "palette.json", "--out", out / "new"],
        "score": ["score", "--detectors", detector, "--out", out / "new"],
    }
    return calls[name]


@pytest.mark.parametrize("name", NAMES)
def test_any_number(sandbox: Sandbox, name: str) -> None:
    options = sorted(numeric_options(load_command(name)))
    if not options:
        pytest.skip("takes no numbers")

    numbers = st.sampled_from(NUMBERS)

    @examples(8 + 6 * len(options))
    @given(st.sampled_from(options), st.lists(numbers, min_size=4, max_size=4))
    def run(option: tuple[str, int | None], values: list[str]) -> None:
        sandbox.clear()
        words = [*base(name, sandbox.inputs, sandbox.out), f"--{option[0]}"]
        if option[1] == 1:
            words[-1] += f"={values[0]}"
        else:
            # Of several numbers one is hostile.
            words += [values[0], *["1"] * ((option[1] or 1) - 1)]
        answer = sandbox.call(words)
        RAN[f"options of {name}"] += 1
        assert answer.code in (0, 2), answer
        if answer.code == 2:
            assert "Traceback" not in answer.err, answer
            assert answer.err, answer

    run()


def test_numeric_options_are_found() -> None:
    """The walk over the settings can fail: it finds what is known to be there."""
    found = {name: dict(numeric_options(load_command(name))) for name in NAMES}
    assert found["attack"]["settings.learning-rate"] == 1
    assert found["vehicles"]["counts"] == 4
    assert "settings.steps" in found["train"]
    assert sum(map(len, found.values())) > 60
