"""The state of the detectors before any attack: their baseline by image set, and the precheck."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from skyproof.documents import read_document
from skyproof.layout import CLEARING_RECORD, Layout
from skyproof.ranges import Fraction
from skyproof.results.likeness import Likeness
from skyproof.results.precheck import (
    Finding,
    FindingOutcome,
    Kind,
    PrecheckRecord,
    Rate,
    findings,
    misfit_thresholds,
    misses_vehicles,
    worst,
)
from skyproof.results.results import Results
from skyproof.results.score_folder import Baseline
from skyproof.words import detector_name, interval, listed, percent

_FEW_FOUND = 0.8
"""Below this AP, rates say little about real imagery."""

_STRIPS: dict[Kind, str] = {"paint_body": "body panels", "paint_whole": "whole vehicle"}


@dataclass(frozen=True)
class BaselineRow:
    """One set of images without camouflage."""

    name: str
    real: bool  # whether a camera took the images
    contents: str  # images and vehicles, their processing, and the unit of the intervals
    baselines: Sequence[Baseline | None]  # by detector; None where it was not measured


def baseline_sets(results: Results) -> list[BaselineRow]:
    """Lists the image sets of the baseline, rendered ones first, entries by detector."""
    sets = []
    for name in dict.fromkeys(one.dataset for one in results.baselines):
        by_detector = {one.detector: one for one in results.baselines if one.dataset == name}
        some = next(iter(by_detector.values()))
        baselines = [by_detector.get(detector) for detector in results.all_detectors]
        sets.append(BaselineRow(name, some.real, _contents(some), baselines))
    return sorted(sets, key=lambda one: one.real)


def _contents(baseline: Baseline) -> str:
    parts = [f"{baseline.images} images, {baseline.vehicles} vehicles", baseline.note]
    if baseline.clustered_by == "places":
        places = "places" if baseline.real else "background tiles"
        parts.append(f"intervals over {baseline.clusters} {places}")
    else:
        # Images of one flight repeat parked vehicles and share their light, so they are not
        # independent.
        parts.append(
            f"one place: intervals over its {baseline.clusters} images, which are too narrow"
        )
    return "; ".join(part for part in parts if part)


def real_data(results: Results) -> dict[str, str]:
    """Describes the real data behind the report in clauses and sentences; empty without any.

    These are the baseline on photographs, the detectors with a low one, and the removal of vehicles
    from the photographs.
    """
    real = [one for one in baseline_sets(results) if one.real]
    cut = bool(results.rows) and results.sources not in ([], ["procedural"])
    return {
        "scores": _scores(real),
        "weak": _weak(real, results.all_detectors),
        "removed": _removed(results) if cut else "",
    }


class _Removed(Struct, frozen=True):
    labelled_removed: Annotated[int, Meta(ge=0)]
    detected_removed: Annotated[int, Meta(ge=0)]
    masked_share: Fraction


class _Checker(Struct, frozen=True):
    name: str


class _ClearedGround(Struct, frozen=True):
    """The part of a clearing record that the report reads."""

    totals: _Removed
    checked_by: _Checker | str = ""


def _removed(results: Results) -> str:
    """Says whether the vehicles in the photographs were removed."""
    path = Layout(results.folder).backgrounds / CLEARING_RECORD
    if not path.is_file():
        return (
            "Vehicles in the photographs were not removed by skyproof. Any that remain count as "
            "ground in training tiles and as false alarms in test tiles."
        )
    record: _ClearedGround = read_document(path, _ClearedGround, "clear the ground again")
    totals = record.totals
    count = totals.labelled_removed + totals.detected_removed
    removed = (
        f"{count:,} vehicles were removed from the photographs, which filled "
        f"{percent(totals.masked_share)} of the ground."
    )
    if not isinstance(record.checked_by, _Checker):
        return removed
    # A finder is named by its folder, then by its weights in brackets.
    checker = Path(record.checked_by.name.partition(" (")[0]).name
    precheck = results.prechecks.get(checker)
    if precheck is None or not misses_vehicles(precheck):
        return removed
    return (
        f"{removed} {detector_name(checker)} searched for remaining vehicles, but it failed its "
        f"precheck. Look at {path.parent.name}/sheets before you trust the ground."
    )


def _scores(sets: Sequence[BaselineRow]) -> str:
    """Writes "an AP of 21 % (RetinaNet, 15 to 30 %) and … on KIT" for every set."""
    if not sets:
        return ""
    parts = []
    for one in sets:
        cells = []
        for baseline in filter(None, one.baselines):
            ap = baseline.ap_centre_1m
            shown = "" if math.isnan(ap.low) else f", {interval(ap.low, ap.high)}"
            cells.append(f"{percent(ap.estimate)} ({detector_name(baseline.detector)}{shown})")
        parts.append(f"an AP of {listed(cells)} on {one.name}")
    return listed(parts)


def _weak(sets: Sequence[BaselineRow], detectors: Sequence[str]) -> str:
    """Says which detectors stay below `_FEW_FOUND` on a real set."""
    low = {
        each.detector
        for one in sets
        for each in one.baselines
        if each is not None and not each.ap_centre_1m.estimate >= _FEW_FOUND
    }
    weak = [detector_name(name) for name in detectors if name in low]
    if not weak:
        return ""
    return f"{listed(weak)} {'is' if len(weak) == 1 else 'are'} below {percent(_FEW_FOUND)}"


@dataclass(frozen=True)
class PrecheckState:
    """The precheck of one detector."""

    name: str  # in words
    outcome: FindingOutcome | None  # None without a precheck
    words: str  # the worst finding, in a sentence
    likeness: Likeness | None  # None where it was not measured
    baselines: Sequence[str]  # AP and recall by both rules, in sentences

    @property
    def title(self) -> str:
        """The outcome in words; a failure in capitals."""
        if self.outcome is None:
            return "no precheck"
        return f"precheck {self.outcome.upper() if self.outcome == 'failed' else self.outcome}"

    @property
    def unlike(self) -> bool:
        """Whether rendered vehicles are surely not seen like photographed ones."""
        return self.likeness is not None and self.likeness.judges_nobody


@dataclass(frozen=True)
class PrecheckPart:
    """The precheck of a run's detectors, with its limits as sentences.

    `rows` hold for each criterion the finding on every detector with a precheck, None if it was not
    measured. `strips` hold for each detector and kind of paint a title and the rates of all paints.
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
        compared = [each.likeness.sentence for each in self.states if each.likeness is not None]
        return [*states, *compared, *self.notes]


def precheck_part(results: Results) -> PrecheckPart:
    """Reads the prechecks beside the detectors of a run."""
    records = results.prechecks
    found = {name: findings(records[name]) for name in results.detectors if name in records}
    states = [
        _state(name, found.get(name), results.likeness_of(name), _by_both_rules(results, name))
        for name in results.detectors
    ]
    notes = _elsewhere({name: records[name] for name in found}, results)
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


def _state(
    name: str, found: Sequence[Finding] | None, likeness: Likeness | None, baselines: Sequence[str]
) -> PrecheckState:
    if found is None:
        return PrecheckState(detector_name(name), None, "", likeness, baselines)
    last = worst(found)
    words = f"{last.words[0].upper()}{last.words[1:]}."
    return PrecheckState(detector_name(name), last.outcome, words, likeness, baselines)


def _by_both_rules(results: Results, detector: str) -> list[str]:
    """Says by both rules what a detector finds on photographs or, without any, on renders.

    A box that is more than 1 m off says little about whether the vehicle is seen.
    """
    known = [one for one in results.baselines if one.detector == detector and one.leniently]
    shown = [one for one in known if one.real] or known
    return [
        f"On {one.dataset}: AP {percent(one.ap_centre_1m.estimate)} and recall "
        f"{percent(one.recall.estimate)} by centres within 1 m, {one.leniently}."
        for one in shown
    ]


def _elsewhere(records: Mapping[str, PrecheckRecord], results: Results) -> list[str]:
    """Names the detectors whose precheck was made on other scenes."""
    scenes = results.test_scenes
    if not scenes:
        return []
    others: dict[tuple[int, str], list[str]] = {}
    for name, record in records.items():
        if not record.was_made_on(scenes):
            on = record.measured_on
            ground = "procedural ground" if on.sources == ("procedural",) else "imagery"
            others.setdefault((on.scenes, ground), []).append(detector_name(name))
    return [
        f"The precheck of {' and '.join(names)} was made earlier, on {count} scenes of {ground}, "
        "not on the scenes of this run."
        for (count, ground), names in others.items()
    ]
