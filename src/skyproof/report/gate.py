"""Whether the detectors were worth attacking: the first lines of a report, and their table."""

from __future__ import annotations

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
    verdict,
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
class Gate:
    """What a report says of its detectors before anything else.

    Attributes:
        sentences: the first lines, detector by detector.
        names: the detectors that were checked.
        rows: per criterion, what was found of each of them; None where it was not measured.
        strips: per detector and kind of paint all paints, in the order of the lattice.
    """

    sentences: Sequence[str]
    names: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Finding | None]]]
    strips: Sequence[tuple[str, Sequence[Swatch]]]


def read_gate(results: Results) -> Gate:
    """Reads what `skyproof precheck` left beside the detectors of a run.

    Raises:
        StoredFileError: a `precheck.json`, or the file of the test scenes, is damaged.
    """
    records = read_prechecks(Layout(results.folder).detectors)
    found = {name: findings(records[name]) for name in results.judges if name in records}
    sentences = [_sentence(name, found.get(name)) for name in results.judges]
    sentences += _elsewhere({name: records[name].measured_on for name in found}, results)
    for name in results.judges:
        if name in results.detectors:
            sentences += results.detectors[name].doubts(detector_name(name))
    for name in found:
        sentences += misfit_thresholds(records[name].sets)
    if any(name in found and verdict(found[name]) == "failed" for name in results.judges):
        sentences.append(
            "What hides vehicles from a detector that fails may do so for the same reason, and "
            "not because it was learnt."
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
    return Gate(sentences, list(found), rows, strips)


def _sentence(name: str, found: Sequence[Finding] | None) -> str:
    shown = detector_name(name)
    if found is None:
        return (
            f"{shown} was not checked: nothing in this run folder says whether it is worth "
            "attacking (skyproof precheck)."
        )
    said = {
        "passed": "passed the check",
        "borderline": "is borderline in the check",
        "failed": "FAILED the check",
    }
    last = worst(found)
    return f"{shown} {said[last.outcome]}: {last.words}."


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
        f"{' and '.join(names)} {'was' if len(names) == 1 else 'were'} checked before, on {count} "
        f"scenes of {ground}, and not on the scenes of this run."
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
