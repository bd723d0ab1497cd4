"""The first screen: the answer as one large figure, the detectors' state, and what to do next."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from skyproof.camouflage.name import CamouflageName
from skyproof.report.acceptance import Acceptance, Answer, Ruling
from skyproof.report.baseline import BaselineRow, PrecheckPart
from skyproof.results.result import MEAN, Result
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name, hides, interval, listed, percent

_MOST_STEPS = 3
_SEVERITY: tuple[Answer, ...] = (
    "accepted",
    "undecided",
    "not applicable",
    "not valid for this imagery",
    "rejected",
)


@dataclass(frozen=True)
class Opening:
    """The answer as one figure with its interval and meaning, and next steps; some may be empty."""

    tone: Literal["neutral"] | Answer
    label: str
    figure: str
    interval: str
    sentence: str
    next_steps: Sequence[str]


def opening(
    every: Sequence[Result],
    acceptance: Acceptance | None,
    precheck: PrecheckPart,
    baselines: Sequence[BaselineRow],
    *,
    hardened: bool,
) -> Opening:
    """Returns the first screen of a report; `hardened` says that the page explains hardening."""
    steps = _next_steps(every, acceptance, precheck, baselines, hardened)
    if acceptance is not None:
        return _ruled(max(acceptance.rulings, key=lambda each: _SEVERITY.index(each.answer)), steps)
    row = strongest_of(every)
    if row is None:
        return _baseline(baselines, steps)
    whose = "the detectors" if row.detector == MEAN else detector_name(row.detector)
    control = row.strongest or row.random
    words = "The strongest control" if row.strongest else "A random control"
    beside = "" if control is None else f" {words} {hides(control.easr)} without optimisation."
    attack = f"{row.camouflage.in_words} ({row.camouflage})"
    sentence = (
        f"of the vehicles that {whose} found without camouflage are missed with {attack}.{beside}"
    )
    if row.easr.estimate < 0:
        sentence = f"No attack hides vehicles from {whose}: {attack} {hides(row.easr.estimate)}."
    share = percent(max(row.easr.estimate, 0.0))
    label = "Hidden by the strongest attack"
    return Opening("neutral", label, share, _sure(row.easr), sentence, steps)


def strongest_of(every: Sequence[Result]) -> Result | None:
    """Returns the result of the camouflage that hides most; None if no rate is defined."""
    known = [row for row in every if not math.isnan(row.easr.estimate)]
    return max(known, key=lambda row: row.easr.estimate, default=None)


def _ruled(ruling: Ruling, steps: Sequence[str]) -> Opening:
    name = detector_name(ruling.detector)
    label = f"{name}: {ruling.answer.upper()}"
    if ruling.paint is not None:
        paint, hidden = ruling.paint
        how = f"in the plain paint {paint}"
    elif ruling.answer == "not valid for this imagery":
        return Opening(ruling.answer, label, "", "", ruling.sentences[0], steps)
    elif not ruling.attacks:
        return Opening(ruling.answer, f"No verdict on {name}", "", "", ruling.sentences[0], steps)
    else:
        attack, hidden = next(iter(ruling.attacks.items()))
        words = CamouflageName.read(attack.partition(" on ")[0]).in_words
        how = f"with the strongest attack: {words} ({attack})"
    return Opening(
        ruling.answer,
        label,
        percent(hidden.share),
        f"bounds {interval(hidden.at_least, hidden.at_most)} at the risks of the requirement",
        f"of the vehicles found without camouflage are missed {how}.",
        steps,
    )


def _baseline(baselines: Sequence[BaselineRow], steps: Sequence[str]) -> Opening:
    """Returns the opening of a report without camouflages; the lowest baseline is its figure."""
    known = [
        (one.ap_centre_1m, one.detector, each.name)
        for each in baselines
        for one in each.baselines
        if one is not None and not math.isnan(one.ap_centre_1m.estimate)
    ]
    if not known:
        return Opening("neutral", "Nothing was scored", "", "", "", steps)
    lowest, detector, images = min(known, key=lambda one: one[0].estimate)
    share = percent(lowest.estimate)
    words = f"average precision of {detector_name(detector)} on {images}, without camouflage."
    return Opening("neutral", "Lowest baseline", share, _sure(lowest), words, steps)


def _next_steps(
    every: Sequence[Result],
    acceptance: Acceptance | None,
    precheck: PrecheckPart,
    baselines: Sequence[BaselineRow],
    hardened: bool,
) -> list[str]:
    steps = []
    unlike = [state.name for state in precheck.states if state.unlike]
    failed = [
        state.name for state in precheck.states if state.outcome == "failed" and not state.unlike
    ]
    unchecked = [state.name for state in precheck.states if state.outcome is None]
    if unlike:
        steps.append(
            f"Quote no rate of {listed(unlike)} for this imagery, because it does not see "
            "rendered vehicles like photographed ones. Check resolution and labels (--gsd, "
            "--label-classes) first, then train it with renders beside photographs."
        )
    if failed:
        steps.append(
            f"Improve {listed(failed)} first: a detector that fails the precheck loses vehicles to "
            "changes without optimisation, so its attack figures say little."
        )
    if unchecked:
        steps.append(
            f"Run skyproof precheck on {listed(unchecked)}: nothing in this run folder shows yet "
            "whether attacks on them mean anything."
        )
    more = [each for each in acceptance.rulings if each.more_vehicles] if acceptance else []
    if more:
        steps.append("Add test vehicles: the details below say how many would decide.")
    if not any(each.real for each in baselines):
        steps.append(
            "Measure the detectors on annotated photographs (--labels of assess, --frames of "
            "precheck) before you quote a figure for real imagery."
        )
    if hardened:
        steps.append("Harden the detectors as described below, then assess them anew.")
    elif every:
        steps.append("Quote net figures with their intervals when you compare detectors.")
    return steps[:_MOST_STEPS]


def _sure(rate: Interval) -> str:
    if math.isnan(rate.low):
        return "no interval: too few background tiles"
    return f"95 % interval {interval(rate.low, rate.high)}"
