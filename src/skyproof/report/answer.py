"""The result of one camouflage in plain sentences, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skyproof.report.run import Headline
from skyproof.words import detector_name, interval, percent

__all__ = ["answer"]

_THIN = "\u202f"


def answer(headline: Headline) -> list[str]:
    """The result in plain sentences, with its uncertainty."""
    row, several = headline.row, headline.row["detector"] == "mean"
    whose = "these detectors" if several else detector_name(row["detector"])
    if row["easr"] is None:
        silent = [
            detector_name(r["detector"])
            for r in headline.by_detector
            if r["easr"] is None and r is not row
        ]
        who = ", ".join(silent) or whose
        return [
            f"The success rate is undefined, because {who} found none of the vehicles even without camouflage."
        ]
    sentences = [
        f"Of the vehicles that {whose} found before, the camouflage {headline.camouflage} hides "
        f"{percent(row['easr'])} ({_sure(row, 'easr')})."
    ]
    if row["easr"] < 0:
        sentences = [
            f"With the camouflage {headline.camouflage}, {whose} found {percent(-row['easr'])} more vehicles than "
            f"before, not fewer ({_sure(row, 'easr')} for the share hidden)."
        ]
    if several:
        rates = [
            r["easr"]
            for r in headline.by_detector
            if r["detector"] != "mean" and r["easr"] is not None
        ]
        least, most = percent(min(rates)), percent(max(rates))
        alike = f"For every detector it is {most}."
        sentences.append(
            alike if least == most else f"Detector by detector it is {least} to {most}."
        )
    return sentences + _net_sentences(row)


def _net_sentences(row: Mapping[str, Any]) -> list[str]:
    if row["net_easr"] is None:
        return [
            "No random control was run beside it, so it is not known how much of this is due to optimisation."
        ]
    random = row.get("random_easr")
    random = row["easr"] - row["net_easr"] if random is None else random
    net = f"{percent(row['net_easr'])} net ({_sure(row, 'net_easr')})"
    control = f"A random pattern of the same kind hides {percent(random)}."
    low, high = row["net_easr_low"], row["net_easr_high"]
    if low is None or high is None:
        return [control, f"The difference, {net}, has no interval: too few background tiles."]
    if low > 0:
        return [control, f"So {net} is due to optimisation."]
    if high < 0:
        return [control, f"So optimisation did worse than chance: {net}."]
    return [control, f"The difference, {net}, cannot be told from zero."]


def _sure(row: Mapping[str, Any], key: str) -> str:
    low, high = row[f"{key}_low"], row[f"{key}_high"]
    return (
        "no interval: too few background tiles"
        if low is None
        else f"95{_THIN}% interval {interval(low, high)}"
    )
