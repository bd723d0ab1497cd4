"""The findings of a precheck by criterion. Needs no torch.

An estimate within its limit passes. It fails if its whole 95 % interval lies beyond, so that a test
with few vehicles does not fail a detector by chance. In between it is borderline.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from skyproof.results.baseline import Baseline
from skyproof.results.precheck import Kind, PrecheckRecord, Rate
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name, interval, percent

LEAST_AP_RENDERED = 0.95
"""Smallest baseline AP (centre within 1 m) on rendered scenes."""

LEAST_AP_PHOTOGRAPHS = 0.85
"""Smallest baseline AP on photographs, which are new to a detector trained on renders."""

LARGEST_EASR = 0.05
"""Largest EASR of a change without optimisation: the paper's random controls hide 1 to 4 %."""

FindingOutcome = Literal["passed", "borderline", "failed"]

_SEVERITY: dict[FindingOutcome, int] = {"passed": 0, "borderline": 1, "failed": 2}
_MANY: dict[Kind, str] = {
    "paint_body": "plain paints on body panels",
    "paint_whole": "plain paints on the whole vehicle",
    "two_tone": "two-tone paints",
    "blur": "degrees of blur",
    "control": "random controls",
    "sun": "elevations of the sun",
}


@dataclass(frozen=True)
class Finding:
    """The finding of one criterion, such as "plain paints on body panels".

    Attributes:
        words: the finding as a clause.
        figure: the finding as a cell of a table: "RGB (128, 128, 0) 97 % (90 to 99 %)".
        beyond: distance of the estimate beyond its limit; below 0 if it is within.
        rates: rates of the changes, largest first; none for a baseline.
    """

    criterion: str
    outcome: FindingOutcome
    words: str
    figure: str
    beyond: float
    rates: Sequence[Rate] = ()


def findings(record: PrecheckRecord) -> list[Finding]:
    """Judges a detector by every criterion that was measured."""
    baselines = [_baseline(baseline) for baseline in record.sets]
    changed = [(kind, record.of_kind(kind)) for kind in _MANY]
    return [*baselines, *(_changed(rates, kind) for kind, rates in changed if rates)]


def verdict(found: Sequence[Finding]) -> FindingOutcome:
    """The outcome of all criteria together: that of the worst."""
    return worst(found).outcome


def worst(found: Sequence[Finding]) -> Finding:
    """The finding of the worst outcome; among equals the one farthest beyond its limit."""
    return max(found, key=lambda each: (_SEVERITY[each.outcome], each.beyond))


def rate_outcome(rate: Rate) -> FindingOutcome:
    """The outcome of one change alone."""
    return _outcome(rate.easr, -LARGEST_EASR, sign=-1)


def misfit_thresholds(baselines: Sequence[Baseline]) -> list[str]:
    """Names each set to which the frozen threshold does not carry over, in a sentence each."""
    return [
        f"The frozen threshold of {detector_name(check.detector)}, {check.threshold:.2f}, does not "
        f"carry over to {check.dataset}: "
        f"recall {percent(check.recall.estimate)} at precision "
        f"{percent(check.precision.estimate)}; the best one there, {check.best.threshold:.2f}, has "
        f"{percent(check.best.recall)} at {percent(check.best.precision)}."
        for check in baselines
        if check.best is not None and not check.carries_over
    ]


def rate_words(rate: Rate) -> str:
    """The change in words: the paint "#ff8000" as "RGB (255, 128, 0)"."""
    if rate.kind in ("paint_body", "paint_whole", "two_tone"):
        colours = rate.name.removeprefix("#").split("#")
        return "RGB " + " over ".join(str(tuple(bytes.fromhex(colour))) for colour in colours)
    return rate.name


def _baseline(baseline: Baseline) -> Finding:
    least = LEAST_AP_PHOTOGRAPHS if baseline.real else LEAST_AP_RENDERED
    ap = baseline.ap_centre_1m
    return Finding(
        f"baseline AP on {baseline.dataset}",
        _outcome(ap, least, sign=1),
        f"its AP on {baseline.dataset} is {_sure(ap)} (limit {percent(least)})",
        _sure(ap),
        least - ap.estimate,
    )


def _changed(rates: Sequence[Rate], kind: Kind) -> Finding:
    """Judges all changes of a kind by the worst of them."""
    many = _MANY[kind]
    ordered = sorted(rates, key=lambda rate: (-_SEVERITY[rate_outcome(rate)], -rate.easr.estimate))
    largest = ordered[0]
    beyond = [rate for rate in rates if rate.easr.estimate > LARGEST_EASR]
    hides = f"hides {_sure(largest.easr)}"
    if not beyond:
        words = f"of {len(rates)} {many} the worst, {rate_words(largest)}, {hides}"
    else:
        words = (
            f"{len(beyond)} of {len(rates)} {many} hide{'s' if len(beyond) == 1 else ''} more than "
            f"{percent(LARGEST_EASR)}; the worst, {rate_words(largest)}, {hides}"
        )
    excess = largest.easr.estimate - LARGEST_EASR
    figure = f"{rate_words(largest)} {_sure(largest.easr)}"
    return Finding(many, rate_outcome(largest), words, figure, excess, ordered)


def _outcome(value: Interval, limit: float, *, sign: int) -> FindingOutcome:
    """Judges whether sign * value reaches a limit; an undefined interval excludes nothing."""
    ends = [sign * end for end in (value.low, value.high) if not math.isnan(end)]
    if sign * value.estimate >= limit:
        return "passed"
    return "failed" if ends and max(ends) < limit else "borderline"


def _sure(value: Interval) -> str:
    shown = percent(value.estimate)
    return shown if math.isnan(value.low) else f"{shown} ({interval(value.low, value.high)})"
