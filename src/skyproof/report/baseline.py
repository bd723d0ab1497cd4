"""The baseline of the detectors by image set, and the evidence that the page rests on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from skyproof.documents import read_document
from skyproof.layout import CLEARING_RECORD, Layout
from skyproof.ranges import Fraction
from skyproof.results.baseline import Baseline
from skyproof.results.precheck import findings, verdict
from skyproof.results.results import Results
from skyproof.words import detector_name, interval, listed, percent

_FEW_FOUND = 0.8
"""Below this AP, rates say little about real imagery."""


@dataclass(frozen=True)
class BaselineRow:
    """One set of images without camouflage."""

    name: str
    real: bool  # whether a camera took the images
    contents: str  # images and vehicles, their processing, and the unit of the intervals
    baselines: Sequence[Baseline | None]  # by detector; None where it was not measured


@dataclass(frozen=True)
class RealData:
    """Clauses and sentences on the real data behind the numbers; empty where there is none."""

    scores: str  # baseline on photographs
    weak: str  # detectors with a low one
    removed: str  # removal of vehicles from the photographs


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
        # Frames of one flight repeat parked vehicles and share their light: they are not
        # independent.
        parts.append(
            f"one place: intervals over its {baseline.clusters} images, which are too narrow"
        )
    return "; ".join(part for part in parts if part)


def real_data(results: Results) -> RealData:
    """Describes the real data behind the report."""
    real = [one for one in baseline_sets(results) if one.real]
    cut = bool(results.rows) and results.sources not in ([], ["procedural"])
    return RealData(
        _scores(real, results.all_detectors),
        _weak(real, results.all_detectors),
        _removed(results) if cut else "",
    )


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
    if precheck is None or verdict(findings(precheck)) != "failed":
        return removed
    return (
        f"{removed} {detector_name(checker)} searched for remaining vehicles, but it failed its "
        f"precheck. Look at {path.parent.name}/sheets before you trust the ground."
    )


def _scores(sets: Sequence[BaselineRow], detectors: Sequence[str]) -> str:
    """Writes "an AP of 21 % (RetinaNet, 15 to 30 %) and … on KIT" for every set."""
    if not sets:
        return ""
    parts = []
    for one in sets:
        cells = []
        for name, baseline in zip(detectors, one.baselines, strict=True):
            if baseline is not None:
                ap = baseline.ap_centre_1m
                shown = "" if math.isnan(ap.low) else f", {interval(ap.low, ap.high)}"
                cells.append(f"{percent(ap.estimate)} ({detector_name(name)}{shown})")
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
