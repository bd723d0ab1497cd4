"""The precheck of a run's detectors, for the first screen and its table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skyproof.results.precheck import (
    Finding,
    FindingOutcome,
    Kind,
    MeasuredOn,
    Rate,
    findings,
    misfit_thresholds,
    worst,
)
from skyproof.results.results import Results
from skyproof.scenes.scene import scenes_digest
from skyproof.words import detector_name

_STRIPS: dict[Kind, str] = {"paint_body": "body panels", "paint_whole": "whole vehicle"}


@dataclass(frozen=True)
class PrecheckState:
    """The precheck of one detector."""

    name: str  # in words
    outcome: FindingOutcome | None  # None without a precheck
    words: str  # the worst finding, in a sentence

    @property
    def title(self) -> str:
        """The outcome in words; a failure in capitals."""
        if self.outcome is None:
            return "no precheck"
        return f"precheck {self.outcome.upper() if self.outcome == 'failed' else self.outcome}"


@dataclass(frozen=True)
class PrecheckPart:
    """The precheck of a run's detectors.

    Attributes:
        notes: limits of the precheck, a sentence each.
        names: detectors with a precheck.
        rows: per criterion, the finding of each of them; None where it was not measured.
        strips: per detector and kind of paint the rates of all paints, with a title.
    """

    states: Sequence[PrecheckState]
    notes: Sequence[str]
    names: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Finding | None]]]
    strips: Sequence[tuple[str, Sequence[Rate]]]

    @property
    def sentences(self) -> list[str]:
        """States and notes as running text."""
        states = [f"{each.name}: {each.title}. {each.words}".strip() for each in self.states]
        return [*states, *self.notes]


def precheck_part(results: Results) -> PrecheckPart:
    """Reads the prechecks beside the detectors of a run."""
    records = results.prechecks
    found = {name: findings(records[name]) for name in results.detectors if name in records}
    states = [_state(name, found.get(name)) for name in results.detectors]
    notes = _elsewhere({name: records[name].measured_on for name in found}, results)
    for name in results.detectors:
        if name in results.cards:
            notes += results.cards[name].doubts
    for name in found:
        notes += misfit_thresholds(records[name].sets)
    if any(state.outcome == "failed" for state in states):
        notes.append(
            "A detector that fails the precheck may lose vehicles for the reason found there, not "
            "because of the attack."
        )
    by_criterion = [{each.criterion: each for each in own} for own in found.values()]
    criteria = dict.fromkeys(name for own in by_criterion for name in own)
    rows = [(name, [own.get(name) for own in by_criterion]) for name in criteria]
    strips = [
        (f"{detector_name(name)}, {where}", records[name].of_kind(kind))
        for name in found
        for kind, where in _STRIPS.items()
    ]
    return PrecheckPart(states, notes, list(found), rows, strips)


def _state(name: str, found: Sequence[Finding] | None) -> PrecheckState:
    if found is None:
        return PrecheckState(detector_name(name), None, "")
    last = worst(found)
    words = f"{last.words[0].upper()}{last.words[1:]}."
    return PrecheckState(detector_name(name), last.outcome, words)


def _elsewhere(measured: Mapping[str, MeasuredOn], results: Results) -> list[str]:
    """Names the detectors whose precheck was made on other scenes."""
    scenes = results.test_scenes
    if not scenes:
        return []
    others: dict[tuple[int, str], list[str]] = {}
    for name, on in measured.items():
        if on.scenes_sha256 != scenes_digest(scenes[: on.scenes]):
            ground = "procedural ground" if on.sources == ("procedural",) else "imagery"
            others.setdefault((on.scenes, ground), []).append(detector_name(name))
    return [
        f"The precheck of {' and '.join(names)} was made earlier, on {count} scenes of {ground}, "
        "not on the scenes of this run."
        for (count, ground), names in others.items()
    ]
