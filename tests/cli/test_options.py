"""Options out of range are refused in one sentence, before anything is made."""

from dataclasses import dataclass, field
from typing import Annotated, TypedDict

import pytest
from msgspec import Meta

from skyproof import main
from skyproof.ranges import Fraction, Seed, check_ranges
from tests.cli.conftest import Skyproof, flags


class Changes(TypedDict, total=False):
    """What may differ."""

    jitter: Annotated[float, Meta(ge=0, le=10)]


@dataclass(frozen=True)
class Inner:
    """Settings that check themselves."""

    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 0.1

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class Probe:
    """A command."""

    share: Fraction = 0.0
    seed: Seed = 0
    settings: Inner = field(default_factory=Inner)
    changes: Changes = field(default_factory=Changes)

    def run(self) -> None:
        """Says the seed."""
        main.say(f"seed {self.seed}")


@pytest.mark.parametrize(
    ("arguments", "start"),
    [
        ("--share 2", "--share expects a number from 0 up to 1, got 2.0."),
        ("--share=-inf", "--share expects a number from 0 up to 1, got -inf."),
        ("--seed 9223372036854775808", "--seed expects a whole number of at most 64 bits, got"),
        ("--settings.learning-rate 1e300", "--settings.learning-rate expects a number above 0"),
        ("--settings.learning_rate=nan", "--settings.learning_rate expects a number above 0"),
        ("--changes.jitter -1", "--changes.jitter expects a number from 0 up to 10, got -1.0."),
    ],
)
def test_every_field_is_checked_and_named_as_typed(monkeypatch, capsys, arguments, start):
    monkeypatch.setattr(main, "load_command", lambda name: Probe)
    assert main.run(["probe", *flags(arguments)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"skyproof: {start}")
    assert said.err.count("\n") == 1
    assert not said.out


@pytest.mark.parametrize("seed", [-1, -(2**63), 2**63 - 1])
def test_any_seed_of_64_bits_is_taken(monkeypatch, capsys, seed):
    monkeypatch.setattr(main, "load_command", lambda name: Probe)
    assert main.run(["probe", "--seed", str(seed)]) == 0
    assert capsys.readouterr().out == f"seed {seed}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        "demo --sizes.training-images 1000000000",
        "demo --sizes.random-draws -1",
        "demo --sizes.vehicles 1 1 1 0",
        "demo --sizes.image-px 1000000",
        "demo --gsd inf",
        "demo --blur-sigma-px 1e300",
        "demo --seed 9223372036854775808",
        "reproduce --cores 0",
        "reproduce --cores 1000000000",
        "score --detectors a --out b --seed 9223372036854775808",
        "bench --repeats 0",
        "bench --batch-size 1000000000",
        "bench --image-px 8",
    ],
)
def test_numbers_out_of_range_are_refused(skyproof: Skyproof, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    words = arguments.split()
    option = next(
        word for word in words if word.startswith("--") and word not in ("--detectors", "--out")
    )
    skyproof(*words).refused(f"{option} expects")
    assert not list(tmp_path.iterdir())
