"""The result of one camouflage in plain sentences, with its uncertainty."""

from __future__ import annotations

import math

from skyproof.camouflage.name import CamouflageName
from skyproof.report.uncertainty import left_out
from skyproof.results.results import RENDERER
from skyproof.results.rows import MEAN, Contrast, Headline, Row
from skyproof.results.statistics.intervals import Interval
from skyproof.results.worst import WorstCase
from skyproof.words import detector_name, interval, percent, points, renderer_name

_THIN = "\u202f"
_WORTH_SAYING = 0.05


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
    lenient = [] if headline.lenient is None else [_leniently(row, headline.lenient)]
    return [*sentences, *_beside_controls(row), *lenient, *left_out(row)]


def _leniently(row: Row, lenient: Row) -> str:
    """Says what is hidden where half a vehicle finds the vehicle: who counts vehicles loses less
    than who needs their places.
    """
    said = (
        "Counted leniently, where a detection finds a vehicle if its centre lies anywhere in the "
        f"vehicle’s box, it hides {percent(lenient.easr.estimate)} ({_sure(lenient.easr)})"
    )
    beside = row.easr.estimate - lenient.easr.estimate
    if not beside >= _WORTH_SAYING:
        return f"{said}."
    return (
        f"{said}: the other {points(beside).removeprefix('+')} points are vehicles that are still "
        "seen, but more than 1 m from where they are."
    )


def worst_case(case: WorstCase) -> str:
    """Says in a sentence what all attacks together hide from one detector."""
    where = "" if case.renderer == RENDERER else f" on images of the {renderer_name(case.renderer)}"
    words = (
        f"Of the vehicles that {detector_name(case.detector)} found before, at least one of the "
        f"{len(case.attacks)} attacks hides {percent(case.hidden.estimate)}{where} "
        f"({_sure(case.hidden)}); the strongest alone, {case.strongest}, hides "
        f"{percent(case.alone)}"
    )
    if case.random is None or case.net is None:
        return f"{words}."
    return (
        f"{words}. At least one of as many random controls hides {percent(case.random)}: the "
        f"attacks hide {points(case.net.estimate).removeprefix('+')} points more "
        f"({_sure(case.net)})."
    )


def _beside_controls(row: Row) -> list[str]:
    """Says how much more it hides than an average random pattern, and than the best unlearnt one.

    Of a combination it also says what the learnt shape adds.
    """
    sentences = []
    if row.random is not None:
        sentences.append(_more(row.random, "an average random pattern of the same kind"))
    elif row.unlearnt is None:
        sentences.append(
            "No random control was run beside it, so it is not known what just any pattern would "
            "hide."
        )
    if row.drawn_shape is not None:
        sentences.append(_more(row.drawn_shape, "its own texture under random shapes"))
    if row.unlearnt is None:
        sentences.append(
            "No control was chosen beside it, such as the best plain paint or the best of many "
            "random patterns, so it is not known what is due to learning."
        )
        return sentences
    best = f"the best control that was chosen and not learnt, {_how(row.unlearnt.control)}"
    sentences.append(_more(row.unlearnt, best))
    if row.unlearnt.net.low > 0:
        sentences[-1] += " That is due to learning."
    return sentences


def _more(beside: Contrast, control: str) -> str:
    """Says in a sentence whether more is hidden than by a control, and by how much."""
    estimate, low, high = (
        points(value).removeprefix("+")
        for value in (beside.net.estimate, beside.net.low, beside.net.high)
    )
    sure = f"95{_THIN}% interval {low} to {high}"
    hides = f"{control}, which hides {percent(beside.easr)}"
    if math.isnan(beside.net.low):
        return f"It hides {estimate} points more than {hides}; too few tiles for an interval."
    if beside.net.low > 0:
        return f"It hides {estimate} points more ({sure}) than {hides}."
    if beside.net.high < 0:
        return f"It hides fewer than {hides}: {estimate} points ({sure})."
    return f"It cannot be told from {hides}: {estimate} points ({sure})."


def _how(control: CamouflageName) -> str:
    """Says in words how a control was chosen."""
    if control.choice == "search":
        return "found by a random search with as many images"
    if control.choice == "best":
        return "the best of many random draws"
    even = "" if control.magnitude is None else "every vertex out"
    paint = "" if control.constraints is None else "the best plain paint"
    return " and ".join(part for part in (paint, even) if part)


def _sure(rate: Interval) -> str:
    if math.isnan(rate.low):
        return "no interval: too few background tiles"
    return f"95{_THIN}% interval {interval(rate.low, rate.high)}"
