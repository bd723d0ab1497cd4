"""Options out of range are refused in one sentence, before anything is made."""

import io
import os
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Annotated, TypedDict

import pytest
from msgspec import Meta

from skyproof import main
from skyproof.detectors.settings import TRAINING_PRESETS, TrainingChanges
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
    monkeypatch.setattr(main, "load_command", lambda name, commands: Probe)
    assert main.run(["probe", *flags(arguments)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"skyproof: {start}")
    assert said.err.count("\n") == 1
    assert not said.out


@pytest.mark.parametrize("seed", [-1, -(2**63), 2**63 - 1])
def test_any_seed_of_64_bits_is_taken(monkeypatch, capsys, seed):
    monkeypatch.setattr(main, "load_command", lambda name, commands: Probe)
    assert main.run(["probe", "--seed", str(seed)]) == 0
    assert capsys.readouterr().out == f"seed {seed}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        "demo --seed 9223372036854775808",
        "reproduce --cores 0",
        "reproduce --cores 1000000000",
        "score --detectors a --out b --seed 9223372036854775808",
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


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            PermissionError(13, "Permission denied", "/a/b"),
            "/a/b cannot be used: Permission denied",
        ),
        (OSError(30, "Read-only file system", "/a"), "choose a place that can be written"),
        (OSError(28, "No space left on device", "/a"), "free space"),
        (NotADirectoryError(20, "Not a directory", "/a/b"), "move away what is in its place"),
        (OSError("odd"), "a file cannot be used: odd; check it and try again"),
        (MemoryError(), "memory is full"),
        (RecursionError(), "nested too deep"),
    ],
)
def test_what_the_system_refuses_is_one_sentence(monkeypatch, capsys, error, words):
    def fail(self):
        raise error

    monkeypatch.setattr(main, "load_command", lambda name, commands: Probe)
    monkeypatch.setattr(Probe, "run", fail)
    assert main.run(["probe"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert words in said
    assert "free space" in words or "free space" not in said


def test_letters_that_a_terminal_lacks_are_shown(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(main.sys, "stderr", stream)
    main.say_error("a \u00e9")
    assert stream.buffer.getvalue() == b"skyproof: a \\xe9\n"


def test_a_reader_who_has_gone_is_no_error():
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m skyproof --help | true; echo ${{PIPESTATUS[0]}}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() in ("0", "141")
    assert "Traceback" not in done.stderr


def test_training_settings_say_what_they_are_where_nothing_is_asked():
    told = " ".join((TrainingChanges.__doc__ or "").split())
    steps = {key: settings.steps for key, settings in TRAINING_PRESETS.items()}
    assert set(steps.values()) == {600, 800, 10_000}
    assert [key for key, count in steps.items() if count == 800] == [("retinanet", "slim")]
    said = (
        "steps; a slim detector takes 600 (RetinaNet 800) and a full one 10,000 if none are given."
    )
    assert said in told
    done = subprocess.run(
        [sys.executable, "-m", "skyproof", "train", "--help"],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert said.split(" if ")[0] in " ".join(done.stdout.replace("│", " ").split())
