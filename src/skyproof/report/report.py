"""Writes a run's `report.html`, one self-contained page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from msgspec import Struct

from skyproof import words
from skyproof.documents import read_document
from skyproof.errors import RunFolderError
from skyproof.files import alone, inside, write_bytes
from skyproof.layout import Layout
from skyproof.report.acceptance import read_requirement, rule, write_verdict
from skyproof.report.advice import advice, limits
from skyproof.report.answer import answer, worst_case
from skyproof.report.appendix import flat_settings, full_tables
from skyproof.report.checks import checked_sets, standing
from skyproof.report.embedded import embedded, embedded_jpeg
from skyproof.report.figures import condition_figure, forest_figure, many_figure
from skyproof.report.hardening import hardening, readings
from skyproof.report.losses import attack_loss, training_loss
from skyproof.report.opening import opening, strongest_of
from skyproof.report.precheck import precheck_part
from skyproof.report.queries import query_part
from skyproof.report.renderers import Compared, compare_renderers, survival
from skyproof.report.uncertainty import error_rows
from skyproof.results.conditions import Panel, condition_panels
from skyproof.results.result import Headline
from skyproof.results.results import Results
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.worst import worst_cases

_SEED = 20240
_PAIRS_OF_SECOND = 3
_FEW = 4
"""Up to so many camouflages have a section of their own; beyond it all but the strongest share
one."""


@dataclass(frozen=True)
class Section:
    """A further section of the page, handed in by the caller of `write_report`.

    Attributes:
        title: the heading.
        html: what stands below it.
    """

    title: str
    html: Markup


@dataclass(frozen=True)
class _Picture:
    """A pair of pictures as data URIs, with its caption."""

    scene: str
    original: str
    adversarial: str
    caption: str


@dataclass(frozen=True)
class _Second:
    """What the page shows of one camouflage under a second renderer, beside the first."""

    headline: Headline
    answer: Sequence[str]
    rows: Sequence[Compared]
    pairs: Sequence[_Picture]
    conditions: Markup | None


@dataclass(frozen=True)
class _Shown:
    """What the page shows of one camouflage."""

    headline: Headline
    answer: Sequence[str]
    forest: Markup
    pairs: Sequence[_Picture]
    pairs_detector: str
    texture: str | None
    on_vehicle: str | None
    loss: Markup | None
    conditions: Markup | None
    readings: Sequence[str]
    second: _Second | None


@dataclass(frozen=True)
class _Exhibit:
    """What the page shows of one of many camouflages: a pair and how it looks."""

    headline: Headline
    pair: _Picture | None
    on_vehicle: str | None


def write_report(
    run: str | Path | Results,
    requirement: Requirement | None = None,
    *,
    sections: Sequence[Section] = (),
) -> Path:
    """Writes `results.json` and `report.html` into a run folder and returns the page's path.

    Parts of the page whose files are missing are left out, and the page says so. What was written
    before is replaced where it is ours: `results.json` has our form, and beside one that has, the
    page is ours, too.

    Args:
        run: a run folder, or a folder of score folders; or their results, read before.
        requirement: what is asked of the detectors; `verdict.json` is written, too. Where not
            given, it is what an earlier report was asked.
        sections: further sections of the page. They tell the results of many camouflages in full:
            beside them, the page itself has only a picture of each.

    Raises:
        StoredFileError: nothing was scored yet, or a file is damaged; names the file.
        ConfigurationError: the scores do not belong together.
        RunFolderError: the page cannot be written.
    """
    results = run if isinstance(run, Results) else Results.open(run)
    layout = Layout(results.folder)
    # No other report may be written here at the same time; a whole run has a lock of its own.
    with alone(layout.report):
        _refuse_other_files(layout)
        asked = requirement or read_requirement(layout.verdict)
        return _write(results, layout, asked, sections)


def _refuse_other_files(layout: Layout) -> None:
    """Keeps a report from replacing files that are not skyproof's.

    Raises:
        StoredFileError: `results.json` is not ours.
        RunFolderError: there is a page without results of ours.
    """
    if layout.results.exists():
        read_document(layout.results, _Known, "move it away, it is not replaced")
        return
    for place in (layout.report, layout.verdict):
        if place.exists():
            raise RunFolderError(
                f"{place} is there without a results.json beside it, so it may not be of skyproof "
                "and is not replaced; move it away."
            )


class _Known(Struct, frozen=True):
    """The form of `results.json`."""

    rows: list[dict[str, Any]]
    baselines: list[dict[str, Any]]


def _write(
    results: Results,
    layout: Layout,
    requirement: Requirement | None,
    more: Sequence[Section],
) -> Path:
    query = query_part(results)
    alarms = [] if query is None else query.alarms
    acceptance = None if requirement is None else rule(results, requirement, alarms)
    worst = [case for renderer in results.renderers for case in worst_cases(results, renderer)]
    results.write([case.json() for case in worst])
    if requirement is not None and acceptance is not None:
        write_verdict(results, requirement, acceptance, alarms)
    by_camouflage: dict[str, list[Headline]] = {}
    for headline in results.headlines():
        if not headline.camouflage.variant:
            by_camouflage.setdefault(str(headline.camouflage), []).append(headline)
    every = list(by_camouflage.values())
    few = len(every) <= _FEW
    in_full = every if few else [] if more else _strongest(every)
    sections = [_section(results, *headlines[:2]) for headlines in in_full]
    others = [headlines for headlines in every if headlines not in in_full]
    exhibits = [] if few else _exhibits(results, others)
    precheck = precheck_part(results)
    checked = checked_sets(results)
    hardened = hardening(results, every, _panels)
    strongest = strongest_of(every)
    page = (
        _environment()
        .get_template("report.html.j2")
        .render(
            results=results,
            title=results.config.title or "Camouflage robustness of overhead vehicle detectors",
            sections=sections,
            exhibits=exhibits,
            # One camouflage alone needs no name in every heading.
            named=len(sections) > 1 or bool(exhibits),
            overviews=[] if few else _overviews(results),
            worst=[worst_case(case) for case in worst],
            first=every[0][0] if every else None,
            tested=_tested(results, every),
            acceptance=acceptance,
            every=every,
            query=query,
            precheck=precheck,
            standing=standing(results),
            checked=checked,
            opening=opening(every, acceptance, precheck, checked, hardened_by=hardened is not None),
            example=next(iter(_pairs(results, strongest, count=1)), None) if strongest else None,
            tables=full_tables(results),
            errors=error_rows(results),
            more=more,
            training=training_loss(results),
            advice=advice(every[0][0]) if every else [],
            hardening=hardened,
            limits=limits(
                results,
                every,
                asked=query is not None,
                more=bool(more),
            ),
            settings=flat_settings(results.config.every),
        )
    )
    write_bytes(layout.report, page.encode())
    return layout.report


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("skyproof.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (
        words.percent,
        words.points,
        words.interval,
        words.number,
        words.probability,
        words.evidence,
        words.detector_name,
        words.renderer_name,
    )
    environment.filters |= {function.__name__: function for function in filters}
    return environment


def _section(results: Results, headline: Headline, second: Headline | None = None) -> _Shown:
    name = headline.camouflage
    panels = _panels(results, headline)
    return _Shown(
        headline=headline,
        answer=answer(headline),
        forest=Markup(forest_figure(headline)),
        pairs=_pairs(results, headline),
        pairs_detector=headline.detectors[0],
        texture=embedded(results.pattern(name, "texture.png")),
        on_vehicle=embedded(results.pattern(name, "on_vehicle.png")),
        loss=attack_loss(results, headline),
        conditions=Markup(condition_figure(panels)) if panels else None,
        readings=readings(panels),
        second=_second(results, headline, second) if second else None,
    )


def _second(results: Results, first: Headline, headline: Headline) -> _Second:
    panels = _panels(results, headline)
    before = first.renderer
    after = headline.renderer
    gross = results.change([first.camouflage], first=before, second=after)
    net = results.change([first.camouflage], net=True, first=before, second=after)
    pairs = _pairs(results, headline)
    chosen = [pair for pair in pairs if pair.caption.startswith("Chosen by hash")]
    extremes = [pair for pair in pairs if pair not in chosen]
    return _Second(
        headline=headline,
        answer=[*answer(headline), survival(first, headline, gross, net)],
        rows=compare_renderers(results, first, headline),
        pairs=[*chosen[:_PAIRS_OF_SECOND], *extremes],
        conditions=Markup(condition_figure(panels)) if panels else None,
    )


def _strongest(every: Sequence[list[Headline]]) -> Sequence[list[Headline]]:
    """Gives the camouflage that hides most; none where nothing is known."""
    known = [one for one in every if not math.isnan(one[0].row.easr.estimate)]
    return [max(known, key=lambda headlines: headlines[0].row.easr.estimate)] if known else []


def _exhibits(results: Results, every: Sequence[Sequence[Headline]]) -> list[_Exhibit]:
    """Gives one entry per family: of shapes in several magnitudes the one that hides most."""
    strongest: dict[str, Headline] = {}
    for headlines in every:
        headline = headlines[0]
        family = headline.camouflage.family
        known = strongest.setdefault(family, headline)
        if headline.row.easr.estimate > known.row.easr.estimate:
            strongest[family] = headline
    exhibits = []
    for headline in strongest.values():
        pairs = _pairs(results, headline, count=1)
        path = results.pattern(headline.camouflage, "on_vehicle.png")
        sheet = embedded(path, lossless=False)
        exhibits.append(_Exhibit(headline, pairs[0] if pairs else None, sheet))
    return exhibits


def _overviews(results: Results) -> list[tuple[str, Markup]]:
    """Draws per renderer all camouflages but variants in one diagram."""
    figures = []
    for renderer in results.renderers:
        headlines = [
            headline
            for headline in results.headlines()
            if headline.renderer == renderer and not headline.camouflage.variant
        ]
        if headlines:
            figures.append((renderer, Markup(many_figure(headlines))))
    return figures


def _tested(results: Results, every: Sequence[Sequence[Headline]]) -> str:
    """Says what was tested on what, in one sentence."""
    if not every:
        return ""
    first = every[0][0]
    names = [words.detector_name(name) for name in first.detectors]
    many = f"{len(names)} overhead vehicle detector{'s' if len(names) != 1 else ''}"
    second = (
        " The same scenes were then drawn by a second, physics-based renderer, Blender Cycles."
        if len(results.renderers) > 1
        else ""
    )
    return (
        f"{many} ({', '.join(names)}), tested on {words.number(first.row.vehicles)} rendered "
        f"vehicles over {_imagery(results)}, each seen once without and once with camouflage in "
        f"the same place, light and view.{second}"
    )


def _imagery(results: Results) -> str:
    if not results.sources:
        return "ground that is not recorded"
    if results.sources == ["procedural"]:
        return "procedurally generated ground"
    shown = ", ".join(results.sources[:4])
    more = f" and {len(results.sources) - 4} more" if len(results.sources) > 4 else ""
    return f"real imagery ({shown}{more})"


def _panels(results: Results, headline: Headline) -> list[Panel]:
    outcomes = results.outcomes(headline.camouflage, headline.renderer)
    return condition_panels(outcomes, generator=np.random.default_rng(_SEED))


def _pairs(results: Results, headline: Headline, count: int | None = None) -> list[_Picture]:
    pictures = []
    for folder, pair in results.pairs(headline.camouflage, headline.renderer)[:count]:
        caption = (
            f"{pair.why}. {pair.found_before} of {pair.vehicles} vehicles found before, "
            f"{pair.found_after} after."
        )
        document = folder / "pairs.json"
        original = embedded_jpeg(inside(folder, pair.original, document))
        adversarial = embedded_jpeg(inside(folder, pair.adversarial, document))
        pictures.append(_Picture(pair.scene, original, adversarial, caption))
    return pictures
