"""The answers that a finished run prints: shares hidden, verdicts, and the strength of attacks."""

from collections.abc import Collection

from msgspec import Struct

from skyproof.assessment.suite import Suite
from skyproof.console import say
from skyproof.detectors.card import REFERENCE_DETECTORS, read_card, reference_folder
from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH
from skyproof.words import detector_name, hides, interval, percent


class _Answer(Struct, frozen=True):
    """The columns of a row of `results.json` that are printed."""

    camouflage: str
    renderer: str
    detector: str
    match: str
    easr: float | None
    easr_low: float | None
    easr_high: float | None
    net_strongest_control_easr: float | None


class _WorstAnswer(Struct, frozen=True):
    """The share that at least one of the attacks hides from one detector."""

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

    def of(self, camouflages: Collection[str], match: str) -> dict[tuple[str, ...], _Answer]:
        """Returns the rows of these camouflages by one match rule."""
        return {
            (row.camouflage, row.renderer, row.detector): row
            for row in self.rows
            if row.camouflage in camouflages and row.match == match
        }


def say_answers(layout: Layout, camouflages: Collection[str]) -> None:
    """Prints the share that some camouflages hide from each detector."""
    answers = _read(layout)
    lenient = answers.of(camouflages, LENIENT_MATCH)
    for place, row in answers.of(camouflages, MAIN_MATCH).items():
        lenient_easr = lenient[place].easr if place in lenient else None
        say(
            f"  {detector_name(row.detector):<12} {row.camouflage} {hides(row.easr)}"
            f"{_where(row.renderer)} (95 % interval {interval(row.easr_low, row.easr_high)}), net "
            f"of the strongest control {percent(row.net_strongest_control_easr)}"
            + ("" if lenient_easr is None else f", by the lenient rule {percent(lenient_easr)}")
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
    """Compares the rates of a reference detector with the suite's, and stores the comparison.

    A detector must not pass because attacks were weak here. Other detectors have no expected rates.
    """
    compared = []
    for row in _read(layout).of(suite.attacks, MAIN_MATCH).values():
        expected = suite.expected.get(row.detector, {}).get(row.camouflage)
        if expected is None or row.renderer != "torch" or not _is_reference(layout, row.detector):
            continue
        weaker = row.easr is None or row.easr < expected.low
        place = {"detector": row.detector, "camouflage": row.camouflage}
        rates = {"easr": row.easr, "expected": expected.easr, "at_least": expected.low}
        compared.append(place | rates | {"weaker": weaker})
        if weaker:
            say(
                f"  WEAKER THAN EXPECTED: {row.camouflage} {hides(row.easr)} from "
                f"{detector_name(row.detector)} here, and {percent(expected.easr)} (95 % interval "
                f"{interval(expected.low, expected.high)}) on the suite's own machine. Find the "
                "reason before you trust a verdict from this machine."
            )
    if compared:
        strong = sum(not one["weaker"] for one in compared)
        say(f"  Attacks as strong as on the suite's own machine: {strong} of {len(compared)}.")
        write_json(layout.folder / "suite.json", {"version": suite.version, "rows": compared})


def _read(layout: Layout) -> _Answers:
    return read_document(layout.results, _Answers, "give the same command again")


def _where(renderer: str) -> str:
    return "" if renderer == "torch" else " on Blender Cycles images"


def _is_reference(layout: Layout, name: str) -> bool:
    """Whether a run's detector is a reference detector, not just another detector of that name."""
    if name not in REFERENCE_DETECTORS:
        return False
    own = read_card(layout.detector(name))
    reference = read_card(reference_folder(name))
    return (own.threshold, own.weights_sha256) == (reference.threshold, reference.weights_sha256)
