"""Query attacks: started on other detectors, optimised by queries, and compared with gradients."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from skyproof.camouflage.name import QUERIED, TRANSFER, CamouflageName
from skyproof.report.figures import QueryCurve, queries_figure
from skyproof.results.result import LENIENT_MATCH
from skyproof.results.results import Results
from skyproof.results.statistics.intervals import Interval
from skyproof.results.statistics.repeats import SEEDS
from skyproof.words import hides, interval, points

_QUANTILE = 1.96
_KEPT = re.compile(rf"{QUERIED}(?P<images>\d+)")


@dataclass(frozen=True)
class QueryResult:
    """The shares that a query attack and its competitors hide."""

    name: CamouflageName  # without variant
    gradients: Interval | None  # None for a black-box detector
    transfer: Interval | None  # by the camouflage of other detectors
    queried: Interval  # after all queries
    lenient: Interval | None  # the same by the lenient rule
    images: int  # number of queries
    searched: Interval | None  # by a random search with as many queries


@dataclass(frozen=True)
class QueryPart:
    """The page's part on query attacks; `only` if the detector is a black box.

    Each alarm names an attack that hides more by queries than by gradients, and by more than
    another start of either could explain.
    """

    rows: Sequence[QueryResult]
    figure: Markup
    only: bool
    alarms: Sequence[str]
    conclusion: str


def query_part(results: Results) -> QueryPart | None:
    """Returns the results of query attacks; None without any."""
    scored = [CamouflageName.read(key.camouflage) for key in results.counts.series]
    names = list(dict.fromkeys(name for name in scored if _is_final(results, name)))
    if not names:
        return None
    rows = [row for name in names if (row := _row(results, name)) is not None]
    curves = [curve for row in rows for curve in _curves(results, row, scored)]
    only = all(row.gradients is None for row in rows)
    more = [found for row in rows if (found := _more(results, row)) is not None]
    alarms = [told for told, misleads in more if misleads]
    small = [told for told, misleads in more if not misleads]
    conclusion = _conclusion(rows, only, alarms, small)
    return QueryPart(rows, Markup(queries_figure(curves)), only, alarms, conclusion)


def _is_final(results: Results, name: CamouflageName) -> bool:
    """Whether this is the final camouflage of a query attack, and no control."""
    record = results.records.get(str(name))
    return record is not None and record.queries is not None and not name.random


def _row(results: Results, name: CamouflageName) -> QueryResult | None:
    base = name.base
    queried = results.single_interval(str(name))
    record = results.records[str(name)].queries
    if queried is None or record is None:
        return None
    search = base.control.with_variant("search")
    lenient = results.row(name, match=LENIENT_MATCH)
    return QueryResult(
        base,
        results.single_interval(str(base)) if name.variant == QUERIED else None,
        results.single_interval(str(base.with_variant(TRANSFER))),
        queried,
        None if lenient is None else lenient.easr,
        record.images,
        # With gradients, the random search followed losses, so it is no control of queries.
        None if name.variant == QUERIED else results.single_interval(str(search)),
    )


def _curves(
    results: Results, row: QueryResult, scored: Sequence[CamouflageName]
) -> list[QueryCurve]:
    """Success against queries, of the attack and of the random search beside it."""
    own = [(0, row.transfer), *_kept(results, row.name, scored, ""), (row.images, row.queried)]
    curves = [QueryCurve(str(row.name), _known(own), random=False)]
    if row.searched is not None:
        search = [*_kept(results, row.name.control, scored, "search_"), (row.images, row.searched)]
        curves.append(QueryCurve(str(row.name), _known(search), random=True))
    return curves


def _kept(
    results: Results, base: CamouflageName, scored: Sequence[CamouflageName], before: str
) -> list[tuple[int, Interval | None]]:
    """Lists the rates of the copies that were kept on the way, by the number of images."""
    found = {}
    for name in scored:
        match = _KEPT.fullmatch(name.variant.removeprefix(before))
        if match and name.base == base and name.variant.startswith(before):
            found[int(match["images"])] = results.single_interval(str(name))
    return sorted(found.items())


def _known(curve: Sequence[tuple[int, Interval | None]]) -> list[tuple[int, Interval]]:
    return [(images, rate) for images, rate in curve if rate is not None]


def _more(results: Results, row: QueryResult) -> tuple[str, bool] | None:
    """Says how much more queries hide than gradients, and if starts cannot explain it; or None."""
    if row.gradients is None:
        return None
    more = results.difference(str(row.name.with_variant(QUERIED)), str(row.name))
    if more is None or not more.low > 0:
        return None
    told = (
        f"{row.name} {hides(row.gradients.estimate)} by gradients and "
        f"{hides(row.queried.estimate)} by queries: {points(more.estimate)} points (95 % "
        f"interval {interval(more.low, more.high)})."
    )
    # Either attack is one run; another start of it would have ended elsewhere.
    of_starts = _QUANTILE * math.sqrt(2) * SEEDS.usual_sd
    reach = math.hypot(more.estimate - more.low, of_starts)
    return told, more.estimate > reach


def _conclusion(
    rows: Sequence[QueryResult], only: bool, alarms: Sequence[str], small: Sequence[str]
) -> str:
    if only:
        return (
            "This detector is a black box. Every attack was optimised on the detectors that come "
            "with skyproof, then refined by queries to this detector. An attacker with its weights "
            "may hide more."
        )
    if alarms:
        return (
            "Gradient masking: the detector’s gradients mislead attacks, as those of some defences "
            "do. The suite hides less than an attacker could, so no acceptance is given. Attack a "
            "copy of the detector without that defence."
        )
    if small:
        return (
            f"{' '.join(small)} Another start of an attack can change as much, so this is no sign "
            "of gradient masking. The suite’s numbers are not the most that an attack can hide."
        )
    tried = ", ".join(str(row.name) for row in rows)
    return (
        f"Query attacks do not hide significantly more than gradient attacks ({tried}), so there "
        "is no sign of gradient masking."
    )
