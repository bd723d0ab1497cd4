"""What is left of a camouflage under a second renderer, which neither attack nor training saw."""

import math
from dataclasses import dataclass

from skyproof import words
from skyproof.results.result import Result
from skyproof.results.results import RendererChange, Results
from skyproof.results.statistics.intervals import Interval


@dataclass(frozen=True)
class Compared:
    """One detector's rows under two renderers, and by how much EASR and net EASR change."""

    detector: str
    first: Result
    second: Result
    first_random: Result | None
    second_random: Result | None
    change: Interval | None
    net_change: Interval | None


def compare_renderers(results: Results, first: Result, second: Result) -> list[Compared]:
    """Compares the detectors that were scored under both renderers, and their mean."""
    others = {row.detector: row for row in results.by_detector(second)}
    return [
        Compared(
            detector=row.detector,
            first=row,
            second=other,
            first_random=results.control(row),
            second_random=results.control(other),
            change=_difference(results, row, other),
            net_change=_difference(results, row, other, net=True),
        )
        for row in results.by_detector(first)
        if (other := others.get(row.detector)) is not None
    ]


def survival(first: Result, gross: RendererChange | None, net: RendererChange | None) -> str:
    """Says whether the second renderer's images hide as many vehicles as the first's.

    Args:
        first: the result under the first renderer.
        gross, net: how its EASR and its net EASR change, mean over detectors; None where not
            known.
    """
    change = net or gross
    if gross is None or change is None or math.isnan(change.difference.estimate):
        return "It cannot be compared with the other renderer, because a success rate is undefined."
    what = "The share hidden" if net is None else "Net success"
    there = words.renderer_name(first.renderer)
    rates = f"{words.percent(change.second)} here, {words.percent(change.first)} with the {there}"
    limits = change.difference
    if math.isnan(limits.low):
        return f"{what}: {rates}. The difference has no interval: too few background tiles."
    sure = (
        f"95\u202f% interval of the difference {words.points(limits.low)} to "
        f"{words.points(limits.high)} points"
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


def _difference(
    results: Results, first: Result, second: Result, *, net: bool = False
) -> Interval | None:
    change = results.change(
        [first.camouflage],
        detector=first.detector,
        net=net,
        first=first.renderer,
        second=second.renderer,
    )
    undefined = change is None or math.isnan(change.difference.estimate)
    return None if undefined or change is None else change.difference
