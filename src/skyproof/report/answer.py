"""The result of one camouflage in plain sentences, with its uncertainty."""

from __future__ import annotations

import math

from skyproof.report.uncertainty import left_out
from skyproof.results.results import Headline
from skyproof.results.rows import MEAN, Row
from skyproof.results.statistics.intervals import Interval
from skyproof.words import detector_name, interval, percent

__all__ = ["answer"]

_THIN = "\u202f"


def answer(headline: Headline) -> list[str]:
    """Gives the result in plain sentences, with its uncertainty."""
    row = headline.row
    several = row.detector == MEAN
    whose = "these detectors" if several else detector_name(row.detector)
    easr = row.easr.estimate
    if math.isnan(easr):
        silent = [
            detector_name(other.detector)
            for other in headline.by_detector
            if math.isnan(other.easr.estimate) and other is not row
        ]
        return [
            f"The success rate is undefined, because {', '.join(silent) or whose} found none of "
            "the vehicles even without camouflage."
        ]
    sentences = [
        f"Of the vehicles that {whose} found before, the camouflage {headline.camouflage} hides "
        f"{percent(easr)} ({_sure(row.easr)})."
    ]
    if easr < 0:
        sentences = [
            f"With the camouflage {headline.camouflage}, {whose} found {percent(-easr)} more "
            f"vehicles than before, not fewer ({_sure(row.easr)} for the share hidden)."
        ]
    if several:
        rates = [
            other.easr.estimate
            for other in headline.by_detector
            if other.detector != MEAN and not math.isnan(other.easr.estimate)
        ]
        least = percent(min(rates))
        most = percent(max(rates))
        alike = f"For every detector it is {most}."
        sentences.append(
            alike if least == most else f"Detector by detector it is {least} to {most}."
        )
    return [*sentences, *_net_sentences(row), *left_out(row)]


def _net_sentences(row: Row) -> list[str]:
    if row.net_easr is None or row.random_easr is None:
        return [
            "No random control was run beside it, so it is not known how much of this is due to "
            "optimisation."
        ]
    net = f"{percent(row.net_easr.estimate)} net ({_sure(row.net_easr)})"
    control = f"A random pattern of the same kind hides {percent(row.random_easr)}."
    low, high = row.net_easr.low, row.net_easr.high
    if math.isnan(low):
        return [control, f"The difference, {net}, has no interval: too few background tiles."]
    if low > 0:
        return [control, f"So {net} is due to optimisation."]
    if high < 0:
        return [control, f"So optimisation did worse than chance: {net}."]
    return [control, f"The difference, {net}, cannot be told from zero."]


def _sure(rate: Interval) -> str:
    if math.isnan(rate.low):
        return "no interval: too few background tiles"
    return f"95{_THIN}% interval {interval(rate.low, rate.high)}"
