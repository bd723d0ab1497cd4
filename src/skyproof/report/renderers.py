"""What is left of a camouflage under a second renderer, which neither attack nor training ever saw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from skyproof import words
from skyproof.report.run import Headline
from skyproof.results.statistics.intervals import Interval

__all__ = ["Compared", "compare_renderers", "survival"]


@dataclass(frozen=True)
class Compared:
    """One detector's rows under two renderers, those of the random control, and by how much net EASR changes."""

    detector: str
    first: Mapping[str, Any]
    second: Mapping[str, Any]
    first_random: Mapping[str, Any] | None
    second_random: Mapping[str, Any] | None
    change: Interval | None


def compare_renderers(first: Headline, second: Headline) -> list[Compared]:
    """The detectors that judged both renderers' images, and their mean."""
    others = {row["detector"]: row for row in second.by_detector}
    return [
        Compared(
            detector=name,
            first=row,
            second=others[name],
            first_random=first.control.get(name),
            second_random=second.control.get(name),
            change=_change(row, others[name], "net_easr"),
        )
        for row in first.by_detector
        if (name := row["detector"]) in others
    ]


def survival(first: Headline, second: Headline) -> str:
    """Whether the second renderer's images hide as many vehicles as the first's, in a sentence or two."""
    net = first.row["net_easr"] is not None and second.row["net_easr"] is not None
    key, what = ("net_easr", "Net success") if net else ("easr", "The share hidden")
    change, gross = _change(first.row, second.row, key), _change(first.row, second.row, "easr")
    if change is None or gross is None:
        return "It cannot be compared with the other renderer, because a success rate is undefined."
    there = words.renderer_name(first.renderer)
    rates = (
        f"{words.percent(second.row[key])} here, {words.percent(first.row[key])} with the {there}"
    )
    if math.isnan(change.low):
        return f"{what}: {rates}. The difference has no interval: too few background tiles."
    sure = f"95\u202f% interval of the difference {words.points(change.low)} to {words.points(change.high)} points"
    if change.low > 0:
        return f"{what} is higher in this light, which the attack never saw: {rates} ({sure})."
    if change.high >= 0:
        return f"{what} cannot be told apart between the renderers: {rates} ({sure})."
    lower = f"{what} is lower in this light, which the attack never saw: {rates} ({sure})."
    if gross.high < 0:
        return f"{lower} The missing part leant on how the {there} draws light and paint."
    return f"{lower} Random patterns hide more here; the share that {first.camouflage} hides does not clearly fall."


def _change(first: Mapping[str, Any], second: Mapping[str, Any], key: str) -> Interval | None:
    """Second minus first, with the limits of a difference of independent rates (MOVER; Zou and Donner 2008).

    Both renderers draw the same scenes, so the rates rather rise and fall together; then these limits are too wide, not
    too narrow.
    """
    if first[key] is None or second[key] is None:
        return None
    estimate = second[key] - first[key]
    ends = [row[f"{key}_{end}"] for row in (first, second) for end in ("low", "high")]
    if None in ends:
        return Interval(estimate, math.nan, math.nan)
    first_low, first_high, second_low, second_high = ends
    below = math.hypot(second[key] - second_low, first_high - first[key])
    above = math.hypot(second_high - second[key], first[key] - first_low)
    return Interval(estimate, estimate - below, estimate + above)
