"""On which imagery the detectors were checked, what they scored there, and what that means for the report's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof.report.run import Run, is_real
from skyproof.words import detector_name, interval, percent

__all__ = ["CheckedSet", "Standing", "checked_sets", "standing"]

_FEW_FOUND = 0.8
"""Below this AP a detector misses or invents so many real vehicles that its rates say little about real imagery."""


@dataclass(frozen=True)
class CheckedSet:
    """One set of images without camouflage.

    Attributes:
        name: as the evaluation calls it.
        real: whether a camera took the images.
        contents: how many images and vehicles, what was done to them, and what the intervals rest on.
        rows: per detector its row of `clean.json`; None where it was not checked on this set.
    """

    name: str
    real: bool
    contents: str
    rows: Sequence[Mapping[str, Any] | None]


@dataclass(frozen=True)
class Standing:
    """The first lines of the report: on what data its numbers rest, and what follows."""

    heading: str
    sentences: Sequence[str]


def checked_sets(run: Run, detectors: Sequence[str]) -> list[CheckedSet]:
    """The sets of `clean.json`, rendered ones first, with one entry per detector."""
    names = list(dict.fromkeys(str(row.get("dataset")) for row in run.clean))
    sets = []
    for name in names:
        own = {row.get("detector"): row for row in run.clean if str(row.get("dataset")) == name}
        any_row = next(iter(own.values()))
        rows = [own.get(detector) for detector in detectors]
        sets.append(CheckedSet(name, is_real(any_row), _contents(any_row), rows))
    return sorted(sets, key=lambda one: one.real)


def _contents(row: Mapping[str, Any]) -> str:
    counts = [f"{row[key]} {key}" for key in ("images", "vehicles") if row.get(key) is not None]
    parts = [", ".join(counts), str(row.get("note") or "")]
    clusters = row.get("clusters")
    if row.get("clustered_by") == "places":
        parts.append(
            f"intervals over {clusters} {'places' if is_real(row) else 'background tiles'}"
        )
    elif clusters:
        # Frames of one flight repeat parked vehicles and share their light: they are not independent.
        parts.append(f"one place: intervals over its {clusters} images, which is rather too narrow")
    return "; ".join(part for part in parts if part)


def standing(run: Run, detectors: Sequence[str]) -> Standing:
    """What the report rests on, in plain words; where all of it is synthetic, that is said first."""
    real = [one for one in checked_sets(run, detectors) if one.real]
    scores = _scores(real, detectors)
    if run.synthetic_only and not real:
        return Standing(
            "Synthetic data only.",
            [
                "Ground, vehicles and every image that the detectors were checked on are computer-generated; no pixel "
                "comes from a real camera.",
                "The numbers say how the detectors behave in that world. They are not evidence about real imagery: it "
                "was not tested whether these detectors find real vehicles at all. In the published study that this "
                "report follows, detectors trained on renders alone reached an AP of 49 to 64 % on real images.",
                "Check the detectors on annotated real images before you quote a number from here.",
            ],
        )
    if run.synthetic_only:
        heading = "Synthetic ground and vehicles; detectors checked on real images."
        sentences = [
            "No camouflaged image comes from a real camera: the success rates say how the detectors behave in a "
            "computer-generated world, not what painted vehicles would do.",
            f"On real images without camouflage they score {scores}.",
        ]
    elif not run.ground_known:
        heading = "It is not recorded what the ground is."
        sentences = [
            "Every vehicle that is tested is computer-generated; whether the ground under it is, this evaluation does "
            "not say.",
            f"On real images without camouflage the detectors score {scores}."
            if real
            else "The detectors were not checked on real vehicles, so nothing here says whether they find any.",
        ]
    else:
        heading = "Real ground, rendered vehicles."
        sentences = [
            "The ground is real imagery; every vehicle that is tested is computer-generated. Vehicles that stand in "
            "the photographs are taught as ground in training tiles and count as false alarms in test tiles, unless "
            "they were removed beforehand.",
            f"On real vehicles without camouflage the detectors score {scores}."
            if real
            else "The detectors were not checked on real vehicles, so nothing here says whether they find any.",
        ]
    weak = _weak(real, detectors)
    if weak:
        sentences.append(
            f"{weak}: what hides vehicles from detectors this unsure of real ones may say little about real imagery."
        )
    return Standing(heading, sentences)


def _scores(sets: Sequence[CheckedSet], detectors: Sequence[str]) -> str:
    """ "an AP of 21 % (15 to 30 %, RetinaNet) and … on KIT" for every set."""
    parts = []
    for one in sets:
        cells = []
        for name, row in zip(detectors, one.rows, strict=True):
            if row is not None:
                limits = interval(row.get("ap_centre_1m_low"), row.get("ap_centre_1m_high"))
                shown = f", {limits}" if limits != "–" else ""
                cells.append(f"{percent(row.get('ap_centre_1m'))} ({detector_name(name)}{shown})")
        parts.append(f"an AP of {_listed(cells)} on {one.name}")
    return _listed(parts)


def _weak(sets: Sequence[CheckedSet], detectors: Sequence[str]) -> str:
    """Which detectors stay below `_FEW_FOUND` on a real set."""
    weak = [
        name
        for index, name in enumerate(detectors)
        if any(
            (row := one.rows[index]) and (row.get("ap_centre_1m") or 0) < _FEW_FOUND for one in sets
        )
    ]
    if not weak:
        return ""
    names, verb = _listed([detector_name(name) for name in weak]), "is" if len(weak) == 1 else "are"
    return f"{names} {verb} below {percent(_FEW_FOUND)}"


def _listed(words: Sequence[str]) -> str:
    return (
        words[0]
        if len(words) == 1
        else f"{', '.join(words[:-1])} and {words[-1]}"
        if words
        else "nothing"
    )
