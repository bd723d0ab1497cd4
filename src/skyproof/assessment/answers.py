"""What a finished run prints of `results.json`: what its attacks hide, and whether enough."""

from __future__ import annotations

from collections.abc import Collection

from msgspec import Struct

from skyproof.assessment.suite import Suite
from skyproof.console import say
from skyproof.detectors.card import read_card_and_digest
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, reference_folder
from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.words import detector_name, interval, percent


class _Answer(Struct, frozen=True):
    """What is said of one row of `results.json`."""

    camouflage: str
    renderer: str
    detector: str
    match: str
    easr: float | None
    easr_low: float | None
    easr_high: float | None
    net_easr: float | None


class _WorstAnswer(Struct, frozen=True):
    """What all attacks together hide from one detector."""

    detector: str
    renderer: str
    attacks: list[str]
    hidden: float
    hidden_low: float | None
    hidden_high: float | None


class _Ruled(Struct, frozen=True):
    sentences: list[str]


class _Verdict(Struct, frozen=True):
    detectors: list[_Ruled]


class _Answers(Struct, frozen=True):
    rows: list[_Answer]
    worst_cases: list[_WorstAnswer] = []

    def of(self, camouflages: Collection[str], match: str = "centre_1m") -> list[_Answer]:
        """Gives the rows of some camouflages by one rule of what is found."""
        return [row for row in self.rows if row.camouflage in camouflages and row.match == match]


def say_answers(layout: Layout, camouflages: Collection[str]) -> None:
    """Prints what some camouflages hide from each detector."""
    answers = _read(layout)
    lenient = {_place(row): row.easr for row in answers.of(camouflages, "centre_in_box")}
    for row in answers.of(camouflages):
        where = _where(row.renderer)
        half = lenient.get(_place(row))
        say(
            f"  {detector_name(row.detector):<12} {row.camouflage} hides {percent(row.easr)} of "
            f"the vehicles found before{where} (95 % interval "
            f"{interval(row.easr_low, row.easr_high)}); net of a random texture "
            f"{percent(row.net_easr)}"
            + ("" if half is None else f"; where half a vehicle finds it, {percent(half)}")
        )
    for worst in answers.worst_cases:
        say(
            f"  {detector_name(worst.detector):<12} at least one of the {len(worst.attacks)} "
            f"attacks hides {percent(worst.hidden)}{_where(worst.renderer)} (95 % interval "
            f"{interval(worst.hidden_low, worst.hidden_high)})"
        )


def say_verdict(layout: Layout) -> None:
    """Prints whether each detector is accepted, and why."""
    verdict: _Verdict = read_document(layout.verdict, _Verdict, "report again")
    for ruled in verdict.detectors:
        say(" ".join(ruled.sentences))


def say_expected(layout: Layout, suite: Suite) -> None:
    """Compares a reference detector's rows with those of the suite, and keeps what was found.

    This tells whether attacks are as strong here as where the suite was made: a weak attack must
    not buy a pass. Nothing is said of other detectors, of which nobody knows what to expect.

    Args:
        layout: of a finished run on drawn ground with seed 0.
        suite: whose numbers are expected.
    """
    compared = []
    for row in _read(layout).of(suite.attacks):
        if row.renderer != "torch" or not _is_reference(layout, row.detector):
            continue
        expected = suite.expected.get(row.detector, {}).get(row.camouflage)
        if expected is None:
            continue
        weaker = row.easr is None or row.easr < expected.low
        compared.append(
            {
                "detector": row.detector,
                "camouflage": row.camouflage,
                "easr": row.easr,
                "expected": expected.easr,
                "at_least": expected.low,
                "weaker": weaker,
            }
        )
        if weaker:
            say(
                f"  WEAKER THAN EXPECTED: {row.camouflage} hides {percent(row.easr)} from "
                f"{detector_name(row.detector)}, and hid {percent(expected.easr)} (95 % interval "
                f"{interval(expected.low, expected.high)}) where the suite was made; no verdict "
                "from this machine is to be trusted before the reason is found."
            )
    if compared:
        weak = sum(bool(one["weaker"]) for one in compared)
        say(
            f"  Attacks as strong as where the suite was made: {len(compared) - weak} of "
            f"{len(compared)}."
        )
        write_json(layout.folder / "suite.json", {"version": suite.version, "rows": compared})


def _read(layout: Layout) -> _Answers:
    answers: _Answers = read_document(layout.results, _Answers, "give the same command again")
    return answers


def _place(row: _Answer) -> tuple[str, str, str]:
    return row.camouflage, row.renderer, row.detector


def _where(renderer: str) -> str:
    return "" if renderer == "torch" else " on Blender Cycles images"


def _is_reference(layout: Layout, name: str) -> bool:
    """Whether a run's detector is one that came with skyproof, and not another of its name."""
    if name not in REFERENCE_DETECTORS:
        return False
    own, reference = (
        read_card_and_digest(folder / "detector.json")
        for folder in (layout.detector(name), reference_folder(name))
    )
    return (own[0].threshold, own[1]) == (reference[0].threshold, reference[1])
