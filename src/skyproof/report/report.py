"""Writes a run's `report.html`, one self-contained page."""

import json
from collections.abc import Mapping, Sequence
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
from skyproof.files import alone, inside, refuse_links, write_bytes
from skyproof.layout import Layout
from skyproof.report.acceptance import read_requirement, rule, scored_suite, write_verdict
from skyproof.report.advice import advice, hardening, limits, readings
from skyproof.report.answer import answer, changes, compare_renderers, survival, worst_case
from skyproof.report.baseline import baseline_sets, precheck_part, real_data
from skyproof.report.figures import (
    condition_figure,
    embedded,
    embedded_jpeg,
    forest_figure,
    loss_figure,
)
from skyproof.report.hardened import beside_parent
from skyproof.report.opening import opening, strongest_of
from skyproof.report.queries import query_part
from skyproof.results.conditions import Panel, condition_panels
from skyproof.results.likeness import LARGEST_DIFFERENCE, LEAST_OVERLAP
from skyproof.results.operating_points import EQUAL_ALARMS, alarms_in_words
from skyproof.results.precheck import rate_outcome, rate_words
from skyproof.results.result import FROZEN, Result
from skyproof.results.results import Results
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.stored import read_log
from skyproof.results.worst import worst_cases

_SEED = 20240
_BRIGHT = 128
_PAIRS_OF_SECOND = 3
_FEW = 4
"""Up to this number of camouflages, each has a section of its own. Beyond it, all but the strongest
share one."""


@dataclass(frozen=True)
class Section:
    """A further section of the page, handed in by the caller of `write_report`."""

    title: str
    html: Markup


@dataclass(frozen=True)
class _Picture:
    """A pair of pictures as data URIs, with its caption."""

    scene: str
    original: str
    adversarial: str
    caption: str


def write_report(
    run: str | Path | Results,
    requirement: Requirement | None = None,
    *,
    sections: Sequence[Section] = (),
) -> Path:
    """Writes `results.json` and `report.html` into a run folder and returns the page's path.

    The page says which of its parts are left out because their files are missing. An earlier page
    is replaced if the `results.json` beside it is one of skyproof.

    Args:
        run: a run folder, a folder of score folders, or their results.
        requirement: requirement on the detectors, for which `verdict.json` is written as well;
            that of an earlier report by default.
        sections: further sections of the page with the results of many camouflages in full; the
            page itself then has only a picture of each.

    Raises:
        StoredFileError: nothing was scored yet, or a file is damaged.
        ConfigurationError: the scores do not belong together.
        RunFolderError: the page cannot be written.
    """
    results = run if isinstance(run, Results) else Results.open(run)
    layout = Layout(results.folder)
    # No other report may be written here at the same time; a whole run has a lock of its own.
    with alone(layout.report):
        refuse_links(layout.folder)
        _refuse_other_files(layout)
        return _write(results, layout, requirement or read_requirement(layout.verdict), sections)


def _refuse_other_files(layout: Layout) -> None:
    """Keeps a report from replacing files that are not skyproof's."""
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
    results: Results, layout: Layout, requirement: Requirement | None, more: Sequence[Section]
) -> Path:
    query = query_part(results)
    alarms = [] if query is None else query.alarms
    acceptance = None if requirement is None else rule(results, requirement, alarms)
    worst = [case for renderer in results.renderers for case in worst_cases(results, renderer)]
    results.write([case.json() for case in worst])
    if acceptance is not None:
        write_verdict(results, acceptance, alarms)
    contents = _Contents(results)
    every = contents.every
    strongest = strongest_of(every)
    few = len(every) <= _FEW
    in_full = every if few else [strongest] if strongest and not more else []
    exhibits = [] if few else _exhibits([row for row in every if row not in in_full])
    precheck = precheck_part(results)
    baselines = baseline_sets(results)
    beside = beside_parent(results)
    advised = None if beside else hardening(results, every)
    page = templates("skyproof.report").get_template("report.html.j2")
    html = page.render(
        results=results,
        contents=contents,
        title=results.config.title or "Camouflage robustness of overhead vehicle detectors",
        every=every,
        in_full=in_full,
        exhibits=exhibits,
        # One camouflage alone needs no name in every heading.
        named=len(in_full) > 1 or bool(exhibits),
        overviews=[] if few else contents.overviews(),
        worst=[worst_case(case) for case in worst],
        tested=_tested(results, every),
        acceptance=acceptance,
        query=query,
        precheck=precheck,
        real=real_data(results),
        baselines=baselines,
        bounds=(LARGEST_DIFFERENCE, LEAST_OVERLAP),
        points=_points(results),
        alarms=alarms_in_words(results.points),
        beside=beside,
        opening=opening(every, acceptance, precheck, baselines, hardened=advised is not None),
        strongest=str(strongest.camouflage) if strongest else "",
        example=next(iter(contents.pairs(strongest, 1)), None) if strongest else None,
        more=more,
        training=contents.training(),
        advice=advice(results.by_detector(every[0])) if every else [],
        hardening=advised,
        limits=limits(results, every),
        settings=_flat_settings(_settings(results)),
    )
    write_bytes(layout.report, html.encode())
    return layout.report


def _points(results: Results) -> dict[str, str]:
    """The operating points at which rates are known, with their headings."""
    known = {row.operating_point for row in results.equal_alarms}
    others = {
        name: f"at {rate} false alarms per km²"
        for name, rate in EQUAL_ALARMS.items()
        if name in known
    }
    return {FROZEN: "at the frozen threshold"} | others


def templates(package: str) -> jinja2.Environment:
    """Opens the templates of a package, with filters that put numbers and names in words."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    own = {"rate_outcome": rate_outcome, "rate_words": rate_words, "ink": ink, "readings": readings}
    environment.filters |= vars(words) | own
    return environment


def ink(colour: str) -> str:
    """Returns black or white, whichever is legible on a colour such as "#ff8000"."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return "#000" if 0.3 * red + 0.59 * green + 0.11 * blue > _BRIGHT else "#fff"


class _Contents:
    """Words, figures and pictures of single results, for the template."""

    def __init__(self, results: Results) -> None:
        self._results = results
        self._panels: dict[tuple[str, str], list[Panel]] = {}
        self._quoted = [row for row in results.quoted if not row.camouflage.variant]
        first: dict[str, Result] = {}
        for row in self._quoted:
            first.setdefault(str(row.camouflage), row)
        self.every = list(first.values())

    def second(self, row: Result) -> Result | None:
        """Returns a camouflage's result under the other renderer; None without one."""
        same = (other for other in self._quoted if other.camouflage == row.camouflage)
        return next((other for other in same if other.renderer != row.renderer), None)

    def answer(self, row: Result) -> list[str]:
        return answer(self._results.by_detector(row), self._results.lenient(row))

    def answer_beside(self, first: Result, second: Result) -> list[str]:
        """Returns the answer under the second renderer, and whether the success survives it."""
        return [*self.answer(second), survival(first, *changes(self._results, first, second))]

    def compared(self, first: Result, second: Result) -> Sequence[Any]:
        return compare_renderers(self._results, first, second)

    def forest(self, row: Result) -> Markup:
        rows = self._results.by_detector(row)
        labels = [words.detector_name(each.detector) for each in rows]
        return self._forest(f"forest-{row.camouflage}-{row.renderer}", labels, rows)

    def overviews(self) -> list[tuple[str, Markup]]:
        """Draws all camouflages in one diagram per renderer."""
        figures = []
        for renderer in self._results.renderers:
            rows = [row for row in self._quoted if row.renderer == renderer]
            if rows:
                labels = [str(row.camouflage) for row in rows]
                figures.append((renderer, self._forest(f"many-{renderer}", labels, rows)))
        return figures

    def _forest(self, salt: str, labels: Sequence[str], rows: Sequence[Result]) -> Markup:
        controls = [self._results.control(row) for row in rows]
        return Markup(forest_figure(salt, labels, rows, controls))

    def panels(self, row: Result) -> list[Panel]:
        key = (str(row.camouflage), row.renderer)
        if key not in self._panels:
            outcomes = self._results.outcomes(row.camouflage, row.renderer)
            self._panels[key] = condition_panels(outcomes, generator=np.random.default_rng(_SEED))
        return self._panels[key]

    def conditions(self, row: Result) -> Markup | None:
        panels = self.panels(row)
        return Markup(condition_figure(panels)) if panels else None

    def loss(self, row: Result) -> Markup | None:
        """Draws the losses of an attack against its steps; None where they are not kept."""
        path = self._results.pattern(row.camouflage, "steps.jsonl")
        curves: dict[str, list[tuple[float, float]]] = {}
        for step in [] if path is None else read_log(path):
            losses = step.losses or ({} if step.loss is None else {"all": step.loss})
            for detector, loss in losses.items():
                curves.setdefault(detector, []).append((float(step.step), loss))
        title = f"Attack {row.camouflage}: loss per detector"
        return Markup(loss_figure(title, curves)) if curves else None

    def training(self) -> Markup | None:
        """Draws the losses of the detectors' trainings; None where none is kept."""
        curves = {}
        for name in self._results.cards:
            path = Layout(self._results.folder).detector(name) / "steps.jsonl"
            # Validations in the log have no loss.
            rows = read_log(path) if path.exists() else []
            points = [(float(row.step), row.loss) for row in rows if row.loss is not None]
            if points:
                curves[name] = points
        return Markup(loss_figure("Training of the detectors", curves)) if curves else None

    def picture(self, row: Result, file: str, *, lossless: bool = True) -> str | None:
        path = self._results.pattern(row.camouflage, file)
        return None if path is None else embedded(path, lossless=lossless)

    def pairs(self, row: Result, count: int | None = None) -> list[_Picture]:
        """Returns the pictured scenes of a camouflage, or the first ones."""
        pictures = []
        for folder, pair in self._results.pairs(row.camouflage, row.renderer)[:count]:
            caption = (
                f"{pair.why}. {pair.found_before} of {pair.vehicles} vehicles found before, "
                f"{pair.found_after} after."
            )
            document = folder / "pairs.json"
            original = embedded_jpeg(inside(folder, pair.original, document))
            adversarial = embedded_jpeg(inside(folder, pair.adversarial, document))
            pictures.append(_Picture(pair.scene, original, adversarial, caption))
        return pictures

    def fewer_pairs(self, row: Result) -> list[_Picture]:
        """Returns the first scenes that were chosen by hash, and the extremes."""
        pairs = self.pairs(row)
        chosen = [pair for pair in pairs if pair.caption.startswith("Chosen by hash")]
        return [*chosen[:_PAIRS_OF_SECOND], *(pair for pair in pairs if pair not in chosen)]


def _exhibits(every: Sequence[Result]) -> list[Result]:
    """Returns one result per family; of several magnitudes of a shape, the one that hides most."""
    strongest: dict[str, Result] = {}
    for row in every:
        known = strongest.setdefault(row.camouflage.family, row)
        if row.easr.estimate > known.easr.estimate:
            strongest[row.camouflage.family] = row
    return list(strongest.values())


def _tested(results: Results, every: Sequence[Result]) -> str:
    if not every:
        return ""
    rows = results.by_detector(every[0])
    names = [words.detector_name(row.detector) for row in rows[: max(len(rows) - 1, 1)]]
    many = words.counted(len(names), "overhead vehicle detector")
    many += " was" if len(names) == 1 else " were"
    drew = " A second, physics-based renderer, Blender Cycles, drew the same scenes."
    second = drew if len(results.renderers) > 1 else ""
    return (
        f"{many} tested ({', '.join(names)}) on {words.number(every[0].vehicles)} rendered "
        f"vehicles over {_imagery(results)}. Each vehicle was shown once without and once with "
        f"camouflage, in the same place, light and view.{second}"
    )


def _imagery(results: Results) -> str:
    if not results.sources:
        return "ground that is not recorded"
    if results.sources == ["procedural"]:
        return "procedurally generated ground"
    shown = ", ".join(results.sources[:4])
    more = f" and {len(results.sources) - 4} more" if len(results.sources) > 4 else ""
    return f"real imagery ({shown}{more})"


def _settings(results: Results) -> Mapping[str, Any]:
    """The settings of a run, whose suite is named only if all of it was scored."""
    every = results.config.every
    return {**every, "suite": scored_suite(results)[0]} if "suite" in every else every


def _flat_settings(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Settings as dotted names and values."""
    if isinstance(value, Mapping):
        return [
            pair
            for key, inner in value.items()
            for pair in _flat_settings(inner, f"{prefix}.{key}" if prefix else str(key))
        ]
    if isinstance(value, list):
        plain = all(not isinstance(item, list | dict) for item in value)
        return [(prefix, ", ".join(map(str, value)) if plain else json.dumps(value))]
    return [(prefix, str(value))]
