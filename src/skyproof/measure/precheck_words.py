"""The lines that `skyproof precheck` prints for one detector."""

from collections.abc import Sequence
from textwrap import wrap

from skyproof.results.baseline import Baseline
from skyproof.results.precheck import (
    LARGEST_EASR,
    Finding,
    PrecheckRecord,
    findings,
    misfit_thresholds,
    rate_words,
    verdict,
)
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name, interval, percent

_FEW = 6
"""Up to this number all changes are printed, above it only the worst."""

_WORST = 3
_WIDTH = 110
_INDENT = 48


def lines(record: PrecheckRecord, doubts: Sequence[str] = ()) -> list[str]:
    """Tells in a few lines what was measured, the findings, and the doubts of the card."""
    found = findings(record)
    told = [
        f"{detector_name(record.detector)}: {verdict(found).upper()} "
        f"({record.measured_on.scenes} scenes, threshold {record.threshold:.3f})"
    ]
    for check, finding in zip(record.sets, found, strict=False):
        told += _told(check.dataset, finding, _set(check))
    for finding in found[len(record.sets) :]:
        told += _told(finding.criterion, finding, _changes(finding))
    return told + [
        line
        for sentence in (*doubts, *misfit_thresholds(record.sets))
        for line in wrap(f"  {sentence}", _WIDTH, subsequent_indent="  ")
    ]


def _told(title: str, finding: Finding, words: str) -> list[str]:
    head = f"  {title:<34}{finding.outcome:<12}"
    return wrap(head + words, _WIDTH, subsequent_indent=" " * _INDENT)


def _set(check: Baseline) -> str:
    best = check.best
    other = "" if best is None else f"; largest F1 at {best.threshold:.3f}"
    return (
        f"AP {_sure(check.ap_centre_1m)}, precision {_sure(check.precision)}, recall "
        f"{_sure(check.recall)}; {check.vehicles} vehicles, {check.clusters} "
        f"{check.clustered_by}{other}"
    )


def _changes(finding: Finding) -> str:
    rates = finding.rates
    beyond = [rate for rate in rates if rate.easr.estimate > LARGEST_EASR]
    shown = rates if len(rates) <= _FEW else (beyond or rates[:1])[:_WORST]
    words = ", ".join(f"{rate_words(rate)} {_sure(rate.easr)}" for rate in shown)
    return f"{len(beyond)} of {len(rates)} hide more than {percent(LARGEST_EASR)}: {words}"


def _sure(value: Interval) -> str:
    return f"{percent(value.estimate)} ({interval(value.low, value.high)})"
