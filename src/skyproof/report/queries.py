"""What answers alone reach: carried over from other detectors, then asked for; beside gradients."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from skyproof.camouflage.name import ASKED, TRANSFER, CamouflageName
from skyproof.report.queries_figure import Curve, queries_figure
from skyproof.results.results import Results
from skyproof.results.rows import LENIENT_MATCH
from skyproof.results.statistics.intervals import Interval
from skyproof.results.statistics.repeats import SEEDS
from skyproof.words import interval, percent, points

_QUANTILE = 1.96
_KEPT = re.compile(rf"{ASKED}(?P<images>\d+)")


@dataclass(frozen=True)
class Row:
    """One attack.

    Attributes:
        name: its.
        gradients: share hidden by what was learnt on the detector itself; None of a black box.
        transfer: by what was learnt on other detectors.
        asked: after all answers.
        lenient: the same where half a vehicle finds the vehicle; None where that was not scored.
        images: how many these were.
        searched: by a random search with as many answers; None where there was none.
    """

    name: CamouflageName
    gradients: Interval | None
    transfer: Interval | None
    asked: Interval
    lenient: Interval | None
    images: int
    searched: Interval | None


@dataclass(frozen=True)
class ByAnswers:
    """What the page shows of attacks by answers.

    Attributes:
        rows: one per attack.
        figure: success against answers.
        only: whether the detector has nothing but answers.
        alarms: a sentence for every attack that hides more by answers than by gradients, and by
            more than another start of either could explain.
        told: a sentence that says what it comes to.
    """

    rows: Sequence[Row]
    figure: Markup
    only: bool
    alarms: Sequence[str]
    told: str


@dataclass(frozen=True)
class _More:
    """That answers hide more than gradients, and whether by more than starts explain."""

    told: str
    misleads: bool


def by_answers(results: Results) -> ByAnswers | None:
    """Gives what was reached by answers alone; None where nothing was asked."""
    scored = [CamouflageName.read(key.camouflage) for key in results.tiles.series]
    names = list(dict.fromkeys(name for name in scored if _is_final(results, name)))
    if not names:
        return None
    rows = [row for name in names if (row := _row(results, name)) is not None]
    curves = [curve for row in rows for curve in _curves(results, row, scored)]
    only = all(row.gradients is None for row in rows)
    more = [found for row in rows if (found := _more(results, row)) is not None]
    alarms = [found.told for found in more if found.misleads]
    small = [found.told for found in more if not found.misleads]
    told = _told(rows, only, alarms, small)
    return ByAnswers(rows, Markup(queries_figure(curves)), only, alarms, told)


def _is_final(results: Results, name: CamouflageName) -> bool:
    """Whether it is the end of a search by answers, and no control."""
    record = results.records.get(str(name))
    return record is not None and record.queries is not None and not name.random


def _row(results: Results, name: CamouflageName) -> Row | None:
    base = name.base
    asked = results.single_interval(str(name))
    record = results.records[str(name)].queries
    if asked is None or record is None:
        return None
    search = base.control.with_variant("search")
    lenient = results.row(name, match=LENIENT_MATCH)
    return Row(
        base,
        results.single_interval(str(base)) if name.variant == ASKED else None,
        results.single_interval(str(base.with_variant(TRANSFER))),
        asked,
        None if lenient is None else lenient.easr,
        record.images,
        # Beside gradients the random search had losses to go by, and is no control of answers.
        None if name.variant == ASKED else results.single_interval(str(search)),
    )


def _curves(results: Results, row: Row, scored: Sequence[CamouflageName]) -> list[Curve]:
    """Success against answers, of the attack and of the random search beside it."""
    own = [(0, row.transfer), *_kept(results, row.name, scored, ""), (row.images, row.asked)]
    curves = [Curve(str(row.name), _known(own), random=False)]
    if row.searched is not None:
        control = row.name.control
        search = [*_kept(results, control, scored, "search_"), (row.images, row.searched)]
        curves.append(Curve(str(row.name), _known(search), random=True))
    return curves


def _kept(
    results: Results, base: CamouflageName, scored: Sequence[CamouflageName], before: str
) -> list[tuple[int, Interval | None]]:
    """The copies that were kept on the way, by the number of images."""
    found = {}
    for name in scored:
        match = _KEPT.fullmatch(name.variant.removeprefix(before))
        if match and name.base == base and name.variant.startswith(before):
            found[int(match["images"])] = results.single_interval(str(name))
    return sorted(found.items())


def _known(curve: Sequence[tuple[int, Interval | None]]) -> list[tuple[int, Interval]]:
    return [(images, rate) for images, rate in curve if rate is not None]


def _more(results: Results, row: Row) -> _More | None:
    """Gives how much more answers surely hide than gradients; None where that is not sure."""
    if row.gradients is None:
        return None
    more = results.difference(str(row.name.with_variant(ASKED)), str(row.name))
    if more is None or not more.low > 0:
        return None
    told = (
        f"{row.name} hides {percent(row.gradients.estimate)} where it follows the detector’s "
        f"gradients, and {percent(row.asked.estimate)} by its answers alone: "
        f"{points(more.estimate)} points (95 % interval {interval(more.low, more.high)})."
    )
    # Either attack is one run; another start of it would have ended elsewhere.
    of_starts = _QUANTILE * math.sqrt(2) * SEEDS.usual_sd
    reach = math.hypot(more.estimate - more.low, of_starts)
    return _More(told, misleads=more.estimate > reach)


def _told(rows: Sequence[Row], only: bool, alarms: Sequence[str], small: Sequence[str]) -> str:
    if only:
        return (
            "Of this detector only answers are known. Every attack was learnt on detectors that "
            "come with skyproof, and then changed by what this detector answered. An attacker who "
            "has its weights may hide more."
        )
    if alarms:
        return (
            "Masking alarm: the detector’s gradients mislead attacks, as some defences do that "
            "only make attacks fail. What the suite hides is less than what can be hidden, and no "
            "acceptance is to be trusted; attack a copy of the detector without that defence."
        )
    if small:
        return (
            f"{' '.join(small)} That is no more than another start of an attack can change, so it "
            "is no sign that gradients mislead; but the suite’s numbers are not the most that can "
            "be hidden."
        )
    tried = ", ".join(str(row.name) for row in rows)
    return (
        f"Answers alone do not surely hide more than gradients do ({tried}), so nothing hints that "
        "the detector’s gradients mislead attacks."
    )
