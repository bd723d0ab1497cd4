"""What reaches the terminal: lines of a bounded length, without what moves its cursor."""

from __future__ import annotations

import pytest

from skyproof.console import say, say_error, shortened
from skyproof.main import run
from skyproof.words import percent


def test_a_long_text_keeps_its_beginning_and_its_end() -> None:
    text = "".join(chr(97 + index % 26) for index in range(10**7))
    cut = shortened(text, 300)
    assert cut == f"{text[:200]}...{text[-100:]}"
    assert shortened("x" * 300, 300) == "x" * 300


@pytest.mark.parametrize(
    "name", ["x" * 10**7, " ".join(["a name"] * 10**6), "é\x1b[2J\u202e" * 10**6]
)
def test_a_name_of_any_length_makes_a_short_sentence(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    say_error(f"{name} is no class; give another of {name}.")
    (line,) = capsys.readouterr().err.splitlines()
    assert len(line) < 1500
    assert line.startswith("skyproof: ")
    assert line.endswith(f"{name[-1]}.".replace("\u202e", "?"))
    assert line.isprintable()
    assert ("; give another of" in line) == (" " not in name)
    say(f"Note: {name} was left out.\nIt hides {percent(0.5)}.")
    note, second = capsys.readouterr().out.splitlines()
    assert len(note) < 4100
    assert note.endswith(" was left out.")
    assert "\x1b" not in note
    assert second == f"It hides {percent(0.5)}."


def test_what_a_program_says_as_it_leaves_is_no_success(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def leaves(reason: object) -> None:
        raise SystemExit(reason)

    for reason, code in ((None, 0), (0, 0), (3, 3), ("no licence", 2)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("skyproof.main.load_command", lambda *_, reason=reason: leaves(reason))
            assert run(["demo"]) == code
    assert capsys.readouterr().err == "skyproof: no licence\n"


def test_a_full_memory_is_told_whoever_says_it(capsys: pytest.CaptureFixture[str]) -> None:
    def full(*_: object) -> type:
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skyproof.main.load_command", full)
        assert run(["demo"]) == 2
        assert "the memory is full" in capsys.readouterr().err
