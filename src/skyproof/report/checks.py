"""On which imagery the detectors were checked, what they scored, and what follows from it."""

from __future__ import annotations

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
from skyproof.results.findings import findings, verdict
from skyproof.results.precheck import read_prechecks
from skyproof.results.results import Results
from skyproof.words import detector_name, interval, percent

_FEW_FOUND = 0.8
"""Below this AP a detector misses or invents so many real vehicles that its rates say little about
real imagery."""


@dataclass(frozen=True)
class CheckedSet:
    """One set of images without camouflage.

    Attributes:
        name: as the evaluation calls it.
        real: whether a camera took the images.
        contents: how many images and vehicles, what was done to them, and what the intervals rest
            on.
        checks: per detector its check; None where it was not checked on this set.
    """

    name: str
    real: bool
    contents: str
    checks: Sequence[Baseline | None]


@dataclass(frozen=True)
class Standing:
    """The first lines of the report: on what data its numbers rest, and what follows."""

    heading: str
    sentences: Sequence[str]


def checked_sets(results: Results) -> list[CheckedSet]:
    """Lists the sets that detectors were checked on, rendered ones first, entries by detector."""
    sets = []
    for name in dict.fromkeys(check.dataset for check in results.checks):
        by_detector = {check.detector: check for check in results.checks if check.dataset == name}
        some = next(iter(by_detector.values()))
        checks = [by_detector.get(detector) for detector in results.checked]
        sets.append(CheckedSet(name, some.real, _contents(some), checks))
    return sorted(sets, key=lambda checked: checked.real)


def _contents(check: Baseline) -> str:
    parts = [f"{check.images} images, {check.vehicles} vehicles", check.note]
    if check.clustered_by == "places":
        places = "places" if check.real else "background tiles"
        parts.append(f"intervals over {check.clusters} {places}")
    else:
        # Frames of one flight repeat parked vehicles and share their light: they are not
        # independent.
        parts.append(
            f"one place: intervals over its {check.clusters} images, which is rather too narrow"
        )
    return "; ".join(part for part in parts if part)


def standing(results: Results) -> Standing:
    """Says what the report rests on, in plain words.

    Where all of it is synthetic, that is said first.
    """
    real = [checked for checked in checked_sets(results) if checked.real]
    scores = _scores(real, results.checked)
    synthetic = results.sources == ["procedural"]
    if synthetic and not real:
        return Standing(
            "Synthetic data only.",
            [
                "Ground, vehicles and every image that the detectors were checked on are "
                "computer-generated; no pixel comes from a real camera.",
                "The numbers say how the detectors behave in that world. They are not evidence "
                "about real imagery: it was not tested whether these detectors find real vehicles "
                "at all. In the published study that this report follows, detectors trained on "
                "renders alone reached an AP of 49 to 64 % on real images.",
                "Check the detectors on annotated real images before you quote a number from here.",
            ],
        )
    unchecked = (
        "The detectors were not checked on real vehicles, so nothing here says whether they find "
        "any."
    )
    if not results.rows:
        heading = "Detectors checked on images without camouflage."
        sentences = ["No camouflage was compared here."]
        if real:
            sentences.append(f"On real images the detectors score {scores}.")
        else:
            sentences.append(unchecked)
    elif synthetic:
        heading = "Synthetic ground and vehicles; detectors checked on real images."
        sentences = [
            "No camouflaged image comes from a real camera: the success rates say how the "
            "detectors behave in a computer-generated world, not what painted vehicles would do.",
            f"On real images without camouflage they score {scores}.",
        ]
    elif not results.sources:
        heading = "It is not recorded what the ground is."
        sentences = [
            "Every vehicle that is tested is computer-generated; whether the ground under it is, "
            "these scores do not say. Give `skyproof score` the --backgrounds of the scenes.",
            f"On real images without camouflage the detectors score {scores}."
            if real
            else unchecked,
        ]
    else:
        heading = "Real ground, rendered vehicles."
        sentences = [
            "The ground is real imagery; every vehicle that is tested is computer-generated.",
            _removed(Layout(results.folder)),
            f"On real vehicles without camouflage the detectors score {scores}."
            if real
            else unchecked,
        ]
    weak = _weak(real, results.checked)
    if weak:
        sentences.append(
            f"{weak}: what hides vehicles from detectors this unsure of real ones may say little "
            "about real imagery."
        )
    return Standing(heading, sentences)


class _Removed(Struct, frozen=True):
    labelled_removed: Annotated[int, Meta(ge=0)]
    detected_removed: Annotated[int, Meta(ge=0)]
    masked_share: Fraction


class _Checker(Struct, frozen=True):
    name: str


class _Clearing(Struct, frozen=True):
    """Of what clearing a background set records, what is told here."""

    totals: _Removed
    checked_by: _Checker | str = ""


def _removed(layout: Layout) -> str:
    """Says what became of the vehicles that stood in the photographs.

    Raises:
        StoredFileError: the record is damaged.
    """
    path = layout.backgrounds / CLEARING_RECORD
    if not path.is_file():
        return (
            "Vehicles that stand in the photographs are taught as ground in training tiles and "
            "count as false alarms in test tiles, unless they were removed beforehand."
        )
    record: _Clearing = read_document(path, _Clearing, "clear the ground again")
    totals = record.totals
    count = totals.labelled_removed + totals.detected_removed
    removed = (
        f"{count:,} vehicles that stood in the photographs were removed, and "
        f"{percent(totals.masked_share)} of the ground was filled for it."
    )
    if not isinstance(record.checked_by, _Checker):
        return removed
    # A finder is named by its folder, then by its weights in brackets.
    checker = Path(record.checked_by.name.partition(" (")[0]).name
    checked = read_prechecks(layout.detectors)
    if checker not in checked or verdict(findings(checked[checker])) != "failed":
        return removed
    return (
        f"{removed} That none is left {detector_name(checker)} told, which failed its check: look "
        f"at {path.parent.name}/sheets before you trust the ground."
    )


def _scores(sets: Sequence[CheckedSet], detectors: Sequence[str]) -> str:
    """Writes "an AP of 21 % (RetinaNet, 15 to 30 %) and … on KIT" for every set."""
    parts = []
    for checked in sets:
        cells = []
        for name, check in zip(detectors, checked.checks, strict=True):
            if check is not None:
                ap = check.ap_centre_1m
                shown = "" if math.isnan(ap.low) else f", {interval(ap.low, ap.high)}"
                cells.append(f"{percent(ap.estimate)} ({detector_name(name)}{shown})")
        parts.append(f"an AP of {_listed(cells)} on {checked.name}")
    return _listed(parts)


def _weak(sets: Sequence[CheckedSet], detectors: Sequence[str]) -> str:
    """Says which detectors stay below `_FEW_FOUND` on a real set."""
    weak = [
        name
        for index, name in enumerate(detectors)
        if any(_is_weak(checked.checks[index]) for checked in sets)
    ]
    if not weak:
        return ""
    names = _listed([detector_name(name) for name in weak])
    return f"{names} {'is' if len(weak) == 1 else 'are'} below {percent(_FEW_FOUND)}"


def _is_weak(check: Baseline | None) -> bool:
    return check is not None and not check.ap_centre_1m.estimate >= _FEW_FOUND


def _listed(words: Sequence[str]) -> str:
    return (
        words[0]
        if len(words) == 1
        else f"{', '.join(words[:-1])} and {words[-1]}"
        if words
        else "nothing"
    )
