"""The result of one camouflage in plain sentences, and whether a second renderer confirms it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from skyproof.results.result import MEAN, Contrast, Result
from skyproof.results.results import RENDERER, RendererChange, Results
from skyproof.results.statistics.intervals import Interval
from skyproof.results.worst import WorstCase
from skyproof.words import detector_name, hides, interval, percent, points, renderer_name

_THIN = "\u202f"
_WORTH_SAYING = 0.05


def answer(rows: Sequence[Result], lenient: Result | None = None) -> list[str]:
    """Returns the results of one camouflage in plain sentences, with their uncertainty.

    The last of the rows by detector is quoted, which is the mean of several; `lenient` is the same
    by the lenient rule.
    """
    row = rows[-1]
    several = row.detector == MEAN
    whose = "these detectors" if several else detector_name(row.detector)
    easr = row.easr.estimate
    if math.isnan(easr):
        undefined = [other for other in rows[:-1] if math.isnan(other.easr.estimate)]
        silent = [detector_name(other.detector) for other in undefined]
        return [
            f"The success rate is undefined: {', '.join(silent) or whose} found none of the "
            "vehicles without camouflage."
        ]
    sentences = [
        f"{row.camouflage} hides {percent(easr)} ({_sure(row.easr)}) of the vehicles that "
        f"{whose} found without camouflage."
    ]
    if easr < 0:
        sentences = [
            f"With {row.camouflage}, {whose} found {percent(-easr)} more vehicles, not fewer "
            f"({_sure(row.easr)} for the share hidden)."
        ]
    if several:
        rates = [other.easr.estimate for other in rows[:-1]]
        known = [rate for rate in rates if not math.isnan(rate)]
        least, most = (percent(bound(known)) for bound in (min, max))
        spread = f"{most} for every detector" if least == most else f"{least} to {most} by detector"
        sentences.append(f"The share is {spread}.")
    sentences += _beside_controls(row)
    if lenient is not None:
        sentences.append(_leniently(row, lenient))
    return [*sentences, *_shown_once(row)]


def _leniently(row: Result, lenient: Result) -> str:
    """Says what is hidden by the lenient rule, which matters for counting vehicles."""
    said = (
        "By the lenient rule, which accepts a detection anywhere in the vehicle’s box, it "
        f"{hides(lenient.easr.estimate)} ({_sure(lenient.easr)})"
    )
    change = row.easr.estimate - lenient.easr.estimate
    sentences = [f"{said}."]
    if change >= _WORTH_SAYING:
        sentences.append(
            f"The other {points(change).removeprefix('+')} points are vehicles detected more than "
            "1 m off their centre."
        )
    if not math.isnan(lenient.called_another_class):
        sentences.append(
            f"On {percent(lenient.called_another_class)} of the vehicles found before only another "
            "class is detected."
        )
    return " ".join(sentences)


def worst_case(case: WorstCase) -> str:
    """Says in a sentence what all attacks together hide from one detector."""
    where = "" if case.renderer == RENDERER else f" on images of the {renderer_name(case.renderer)}"
    words = (
        f"At least one of the {len(case.attacks)} attacks hides {percent(case.hidden.estimate)} "
        f"({_sure(case.hidden)}) of the vehicles that {detector_name(case.detector)} found "
        f"before{where}. The strongest alone, {case.strongest}, hides {percent(case.alone)}"
    )
    if case.random is None or case.net is None:
        return f"{words}."
    return (
        f"{words}. At least one of as many random controls hides {percent(case.random)}, "
        f"{points(case.net.estimate).removeprefix('+')} points less ({_sure(case.net)})."
    )


def _beside_controls(row: Result) -> list[str]:
    """Says how much more a camouflage hides than its controls, and what its shape adds."""
    sentences = []
    if row.random is not None:
        sentences.append(_more(row.random, "an average random pattern of the same kind"))
    elif row.strongest is None:
        sentences.append(
            "No random control was scored, so the share that any pattern hides is unknown."
        )
    if row.drawn_shape is not None:
        sentences.append(_more(row.drawn_shape, "its own texture under random shapes"))
    if row.strongest is None:
        sentences.append(
            "No chosen control was scored (best plain paint, best of many random draws, random "
            "search), so the effect of the optimisation is unknown."
        )
        return sentences
    strongest = f"the strongest control without optimisation, {_how(row.strongest)}"
    sentences.append(_more(row.strongest, strongest))
    if row.strongest.net.low > 0:
        sentences[-1] += " The difference is the optimisation’s own effect."
    return sentences


def _more(beside: Contrast, control: str) -> str:
    """Says in a sentence whether a camouflage hides more than a control, and by how much."""
    estimate, low, high = (
        points(value).removeprefix("+")
        for value in (beside.net.estimate, beside.net.low, beside.net.high)
    )
    sure = f"95{_THIN}% interval {low} to {high}"
    other = f"{control} ({percent(beside.easr)})"
    if math.isnan(beside.net.low):
        return f"It hides {estimate} points more than {other}. Too few tiles for an interval."
    if beside.net.low > 0:
        return f"It hides {estimate} points more ({sure}) than {other}."
    if beside.net.high < 0:
        return f"It hides less than {other}: {estimate} points ({sure})."
    return f"The difference from {other} is not significant: {estimate} points ({sure})."


def _how(beside: Contrast) -> str:
    """Says in words how a control was chosen, or names a single draw or paint."""
    control = beside.control
    if control.choice is None:
        return str(control)
    if control.choice == "search":
        if beside.draws > 1:
            return f"the mean of {beside.draws} random searches, each with as many images"
        return "a random search with as many images"
    if control.choice == "best":
        return "the best of many random draws"
    if control.choice == "pattern":
        return "the best of many random patterns"
    even = "" if control.magnitude is None else "every vertex out"
    paint = "" if control.constraints is None else "the best plain paint"
    return " and ".join(part for part in (paint, even) if part)


def _shown_once(row: Result) -> list[str]:
    """Names each source of variation of which the test has only one example."""
    sentences = []
    if "vehicles" not in row.easr.errors and "tiles" in row.easr.errors:
        sentences.append("One vehicle was tested, so the interval does not cover other vehicles.")
    if row.repeats == 1 and row.camouflage.kind != "other":
        sentences.append(
            "One attack was run, so the interval allows for the largest spread of seeds measured."
        )
    if row.random is not None and row.random.draws == 1:
        sentences.append(
            "One random pattern was drawn, so the net interval allows for the largest spread of "
            "draws measured."
        )
    return sentences


def _sure(rate: Interval) -> str:
    if math.isnan(rate.low):
        return "no interval: too few background tiles"
    return f"95{_THIN}% interval {interval(rate.low, rate.high)}"


@dataclass(frozen=True)
class Compared:
    """One detector's rows under two renderers, and by how much EASR and net EASR change."""

    first: Result
    second: Result
    first_random: Result | None
    second_random: Result | None
    change: RendererChange | None
    net_change: RendererChange | None


def compare_renderers(results: Results, first: Result, second: Result) -> list[Compared]:
    """Compares the detectors that were scored under both renderers, and their mean."""
    others = {row.detector: row for row in results.by_detector(second)}
    return [
        Compared(
            row, other, results.control(row), results.control(other), *changes(results, row, other)
        )
        for row in results.by_detector(first)
        if (other := others.get(row.detector)) is not None
    ]


def changes(
    results: Results, first: Result, second: Result
) -> tuple[RendererChange | None, RendererChange | None]:
    """Returns by how much EASR and net EASR change from one renderer to the other."""
    gross, net = (
        results.change(
            [first.camouflage],
            detector=first.detector,
            net=net,
            first=first.renderer,
            second=second.renderer,
        )
        for net in (False, True)
    )
    return gross, net


def survival(first: Result, gross: RendererChange | None, net: RendererChange | None) -> str:
    """Says from the changes of EASR and net EASR whether success survives the second renderer."""
    change = net or gross
    if gross is None or change is None or math.isnan(change.difference.estimate):
        return "It cannot be compared with the other renderer, because a success rate is undefined."
    what = "The share hidden" if net is None else "Net success"
    there = renderer_name(first.renderer)
    rates = f"{percent(change.second)} here, {percent(change.first)} with the {there}"
    limits = change.difference
    if math.isnan(limits.low):
        return f"{what}: {rates}. The difference has no interval: too few background tiles."
    sure = (
        f"95\u202f% interval of the difference {points(limits.low)} to {points(limits.high)} points"
    )
    if limits.low > 0:
        return f"{what} is higher in this light, which the attack never saw: {rates} ({sure})."
    if limits.high >= 0:
        return f"{what} cannot be told apart between the renderers: {rates} ({sure})."
    lower = f"{what} is lower in this light, which the attack never saw: {rates} ({sure})."
    if gross.difference.high < 0:
        return f"{lower} The missing part leant on how the {there} draws light and paint."
    return (
        f"{lower} Random patterns hide more here; the share that {first.camouflage} hides does not "
        "clearly fall."
    )
