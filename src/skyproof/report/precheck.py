"""Whether the detectors were worth attacking: the first lines of a report, and their table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skyproof.layout import Layout
from skyproof.results.findings import (
    Finding,
    Outcome,
    findings,
    misfit_thresholds,
    rate_outcome,
    rate_words,
    worst,
)
from skyproof.results.precheck import Kind, MeasuredOn, PrecheckRecord, read_prechecks
from skyproof.results.results import Results
from skyproof.scenes.scene import read_scenes, scenes_digest
from skyproof.words import detector_name, interval, percent

_STRIPS: dict[Kind, str] = {"paint_body": "body panels", "paint_whole": "whole vehicle"}
_BRIGHT = 128


@dataclass(frozen=True)
class Swatch:
    """A plain paint as a coloured square.

    Attributes:
        colour: "#ff8000".
        ink: black or white, whichever can be read on it.
        easr: what it hides, in percent, without the unit.
        outcome: passed, borderline or failed.
        words: the paint and its rate in words.
    """

    colour: str
    ink: str
    easr: str
    outcome: Outcome
    words: str


@dataclass(frozen=True)
class State:
    """What the precheck says of one detector.

    Attributes:
        name: as people write it.
        outcome: None where the precheck was not run.
        words: the worst finding, in a sentence.
    """

    name: str
    outcome: Outcome | None
    words: str

    @property
    def title(self) -> str:
        """The outcome in words; a failure is loud."""
        if self.outcome is None:
            return "no precheck"
        return f"precheck {self.outcome.upper() if self.outcome == 'failed' else self.outcome}"


@dataclass(frozen=True)
class PrecheckPart:
    """The precheck of a run's detectors: whether they were worth attacking.

    Attributes:
        states: detector by detector.
        notes: what limits the precheck, a sentence each.
        names: the detectors that were prechecked.
        rows: per criterion, the finding of each of them; None where it was not measured.
        strips: per detector and kind of paint all paints, in the order of the lattice.
    """

    states: Sequence[State]
    notes: Sequence[str]
    names: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Finding | None]]]
    strips: Sequence[tuple[str, Sequence[Swatch]]]

    @property
    def sentences(self) -> list[str]:
        """States and notes as running text."""
        return [
            *(f"{each.name}: {each.title}. {each.words}".strip() for each in self.states),
            *self.notes,
        ]


def precheck_part(results: Results) -> PrecheckPart:
    """Reads what `skyproof precheck` left beside the detectors of a run.

    Raises:
        StoredFileError: a `precheck.json`, or the file of the test scenes, is damaged.
    """
    records = read_prechecks(Layout(results.folder).detectors)
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
    criteria = dict.fromkeys(each.criterion for own in found.values() for each in own)
    rows = [
        (
            name,
            [next((one for one in own if one.criterion == name), None) for own in found.values()],
        )
        for name in criteria
    ]
    strips = [
        (f"{detector_name(name)}, {where}", _swatches(records[name], kind))
        for name in found
        for kind, where in _STRIPS.items()
    ]
    return PrecheckPart(states, notes, list(found), rows, strips)


def _state(name: str, found: Sequence[Finding] | None) -> State:
    shown = detector_name(name)
    if found is None:
        return State(shown, None, "")
    last = worst(found)
    return State(shown, last.outcome, f"{last.words[0].upper()}{last.words[1:]}.")


def _elsewhere(measured: Mapping[str, MeasuredOn], results: Results) -> list[str]:
    """Says of which detectors the check was not made on this run's own test scenes.

    So it is with detectors that were checked before they came into the run.
    """
    place = Layout(results.folder).scenes("test")
    if not measured or not place.exists():
        return []
    scenes = read_scenes(place)
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


def _swatches(record: PrecheckRecord, kind: Kind) -> list[Swatch]:
    swatches = []
    for rate in record.of_kind(kind):
        red, green, blue = bytes.fromhex(rate.name.removeprefix("#"))
        bright = 0.3 * red + 0.59 * green + 0.11 * blue > _BRIGHT
        limits = interval(rate.easr.low, rate.easr.high)
        shown = percent(rate.easr.estimate)
        unit = percent(0).removeprefix("0")
        swatches.append(
            Swatch(
                rate.name,
                "#000" if bright else "#fff",
                shown.removesuffix(unit),
                rate_outcome(rate),
                f"{rate_words(rate)}: {shown} ({limits})",
            )
        )
    return swatches
