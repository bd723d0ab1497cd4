"""Writes a run folder's `report.html`: one self-contained page, made from the folder's files alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from PIL import Image

from skyproof import words
from skyproof.errors import StoredFileError
from skyproof.files import write_bytes
from skyproof.report.answer import answer
from skyproof.report.checks import checked_sets, standing
from skyproof.report.figures import condition_figure, forest_figure, loss_figure
from skyproof.report.pairs import Pair, image_uri, make_pairs
from skyproof.report.renderers import Compared, compare_renderers, survival
from skyproof.report.run import MAIN_MATCH, Headline, Run, read_run
from skyproof.results.conditions import Panel, condition_panels

__all__ = ["write_report"]

_SEED = 20240
_FEW_TILES = 20
_PAIRS_OF_SECOND = 3


@dataclass(frozen=True)
class _Second:
    """What the page shows of one camouflage under a second renderer, beside the first."""

    headline: Headline
    answer: Sequence[str]
    rows: Sequence[Compared]
    pairs: Sequence[Pair]
    conditions: Markup | None


@dataclass(frozen=True)
class _Section:
    """What the page shows of one camouflage."""

    headline: Headline
    answer: Sequence[str]
    forest: Markup
    pairs: Sequence[Pair]
    pairs_detector: str
    texture: str | None
    on_vehicle: str | None
    loss: Markup | None
    conditions: Markup | None
    readings: Sequence[str]
    second: _Second | None


def write_report(run_folder: Path) -> Path:
    """Writes `report.html` into a run folder and returns its path.

    Parts whose files are missing are left out, and the page says so.

    Raises:
        StoredFileError: results.json or config.json is missing or damaged; names the file.
        RunFolderError: the page cannot be written.
    """
    run = read_run(run_folder)
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
        words.detector_name,
        words.renderer_name,
    )
    environment.filters |= {function.__name__: function for function in filters}
    by_camouflage: dict[str, list[Headline]] = {}
    for headline in run.headlines():
        by_camouflage.setdefault(headline.camouflage, []).append(headline)
    sections = [_section(run, *headlines) for headlines in by_camouflage.values()]
    if not sections:
        raise StoredFileError(
            f"{run.folder / 'results.json'} has no camouflage at {MAIN_MATCH}; run the attack first."
        )
    detectors = [
        row["detector"] for row in sections[0].headline.by_detector if row["detector"] != "mean"
    ]
    page = environment.get_template("report.html.j2").render(
        run=run,
        title=run.config.get("title", "Camouflage robustness of overhead vehicle detectors"),
        sections=sections,
        imagery=_imagery(run),
        standing=standing(run, detectors),
        checked=checked_sets(run, detectors),
        tables=_tables(run),
        training=_training(run),
        clean=run.clean,
        advice=_advice(sections, run),
        limits=_limits(sections, run),
        settings=list(_flat(run.config)),
    )
    path = run.folder / "report.html"
    write_bytes(path, page.encode())
    return path


def _section(run: Run, headline: Headline, second: Headline | None = None) -> _Section:
    name, detector = headline.camouflage, _first_detector(headline)
    panels = _panels(run, headline)
    return _Section(
        headline=headline,
        answer=answer(headline),
        forest=Markup(forest_figure(headline)),
        pairs=make_pairs(run, name, headline.renderer, detector),
        pairs_detector=detector,
        texture=_picture(run.folder / "camouflages" / name / "texture.png"),
        on_vehicle=_picture(run.folder / "camouflages" / name / "on_vehicle.png"),
        loss=_attack_loss(run, name),
        conditions=Markup(condition_figure(panels)) if panels else None,
        readings=_readings(panels),
        second=_second(run, headline, second) if second else None,
    )


def _second(run: Run, first: Headline, headline: Headline) -> _Second:
    panels = _panels(run, headline)
    return _Second(
        headline=headline,
        answer=[*answer(headline), survival(first, headline)],
        rows=compare_renderers(first, headline),
        pairs=make_pairs(
            run, headline.camouflage, headline.renderer, _first_detector(first), _PAIRS_OF_SECOND
        ),
        conditions=Markup(condition_figure(panels)) if panels else None,
    )


def _first_detector(headline: Headline) -> str:
    return str(next(row["detector"] for row in headline.by_detector if row["detector"] != "mean"))


def _panels(run: Run, headline: Headline) -> list[Panel]:
    which = (headline.camouflage, headline.renderer, MAIN_MATCH)
    own = [o for o in run.outcomes or () if (o.camouflage, o.renderer, o.match) == which]
    return condition_panels(own, generator=np.random.default_rng(_SEED))


def _picture(path: Path) -> str | None:
    if not path.exists():
        return None
    try:
        with Image.open(path) as opened:
            return image_uri(opened.convert("RGB"), lossless=True)
    except OSError as error:
        raise StoredFileError(
            f"{path} is not a readable image ({error}); run its stage again."
        ) from error


def _attack_loss(run: Run, name: str) -> Markup | None:
    steps = run.steps("camouflages", name)
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in steps:
        for detector, loss in (row.get("losses") or {"all": row["loss"]}).items():
            curves.setdefault(detector, []).append((float(row["step"]), float(loss)))
    return Markup(loss_figure(f"Attack {name}: loss per detector", curves)) if curves else None


def _training(run: Run) -> Markup | None:
    curves = {
        # The log holds validations too, which have no loss.
        name: [
            (float(row["step"]), float(row["loss"]))
            for row in run.steps("detectors", name)
            if "loss" in row
        ]
        for name in run.detectors
    }
    curves = {name: points for name, points in curves.items() if points}
    return Markup(loss_figure("Training of the detectors", curves)) if curves else None


def _imagery(run: Run) -> str:
    if not run.ground_known:
        return "ground that is not recorded"
    imagery = run.config["imagery"]
    if imagery == "procedural":
        return "procedurally generated ground"
    return (
        "real imagery (" + ", ".join(imagery if isinstance(imagery, list) else [str(imagery)]) + ")"
    )


def _tables(run: Run) -> list[tuple[str, list[Mapping[str, Any]]]]:
    """The rows by match criterion and renderer, each with its heading; the main criterion first."""
    criteria = {
        MAIN_MATCH: "found = centre within 1.0 m",
        "iou_50": "found = boxes overlap by IoU ≥ 0.5",
    }
    tables = []
    renderers = list(dict.fromkeys(row["renderer"] for row in run.rows))
    for match, meaning in criteria.items():
        for renderer in renderers:
            name = words.renderer_name(renderer)
            whose = f"Renderer {renderer}" if len(renderers) == 1 else name[0].upper() + name[1:]
            rows = [row for row in run.rows if (row["match"], row["renderer"]) == (match, renderer)]
            if rows:
                tables.append((f"{whose}, {meaning}", rows))
    return tables


def _readings(panels: Sequence[Panel]) -> list[str]:
    """One sentence per panel: whether the intervals of its extremes part company."""
    sentences = []
    for panel in panels:
        known = [bar for bar in panel.bins if bar.rate.low == bar.rate.low]
        if len(known) < 2:
            continue
        least = min(known, key=lambda bar: bar.rate.estimate)
        most = max(known, key=lambda bar: bar.rate.estimate)
        ends = [
            f"{bar.label} ({words.percent(bar.rate.estimate)})".replace("\n", " ")
            for bar in (most, least)
        ]
        if most.rate.low > least.rate.high:
            sentences.append(
                f"{panel.title}: most hidden at {ends[0]}, least at {ends[1]}; the intervals do not overlap."
            )
        else:
            sentences.append(f"{panel.title}: no clear difference; the intervals overlap.")
    return sentences


def _advice(sections: Sequence[_Section], run: Run) -> list[str]:
    """What the numbers suggest for the detectors; never how to hide."""
    headline = sections[0].headline
    single = [
        row for row in headline.by_detector if row["detector"] != "mean" and row["easr"] is not None
    ]
    advice = []
    if len(single) > 1:
        ranked = sorted(single, key=lambda row: row["easr"])
        best, worst = ranked[0], ranked[-1]
        apart = best["easr_high"] is not None and worst["easr_low"] is not None
        if apart and best["easr_high"] < worst["easr_low"]:
            advice.append(
                f"{words.detector_name(best['detector'])} withstands {headline.camouflage} better than "
                f"{words.detector_name(worst['detector'])} ({words.percent(best['easr'])} against "
                f"{words.percent(worst['easr'])} hidden): harden the weaker one first."
            )
        else:
            advice.append(
                "The detectors' intervals overlap: this result gives no ground to prefer one of them."
            )
    random = headline.row.get("random_easr")
    if random is not None and random > 0.1:
        advice.append(
            f"Unlearnt random patterns already hide {words.percent(random)}: the detectors depend on ordinary vehicle "
            "colours. Train with more varied vehicle textures before anything else."
        )
    net_low = headline.row["net_easr_low"]
    if net_low is not None and net_low > 0:
        advice.append(
            "The optimised pattern does more than chance, so variety alone may not suffice: put such camouflaged "
            "vehicles, with their true labels, into training, then measure again with a newly optimised pattern. A "
            "detector hardened against a known pattern is not thereby hardened against the next."
        )
    advice.append(
        "After hardening, check accuracy on clean images and false alarms as well; robustness can cost both."
    )
    advice.append(
        "Quote net success with its interval, not the gross rate, when comparing detectors or suppliers."
    )
    return advice


def _limits(sections: Sequence[_Section], run: Run) -> list[str]:
    row = sections[0].headline.row
    tiles = row.get("clusters")
    limits = []
    if run.synthetic_only:
        limits.append(
            "Ground and vehicles are synthetic. How far these rates carry over to real cameras is not measured here."
        )
    elif run.ground_known:
        limits.append(
            "The ground is real, the vehicles are rendered. Success on painted vehicles is not measured here."
        )
    if any(section.second for section in sections):
        limits.append(
            "Blender Cycles draws the same synthetic vehicle shapes, in another light and with other materials. It "
            "shows whether a camouflage survives a change of renderer, not whether it survives in reality."
        )
    if tiles is not None:
        few = " That is few: read the intervals as rough." if tiles < _FEW_TILES else ""
        limits.append(f"The intervals rest on {tiles} background tiles.{few}")
    limits.append(
        "The intervals cover which scenes were drawn. They do not cover another training of the detectors, another run "
        "of the attack, or other random patterns than those drawn."
    )
    steps = run.steps("camouflages", sections[0].headline.camouflage)
    attacked = (
        [words.detector_name(name) for name in (steps[0].get("losses") or {})] if steps else []
    )
    if attacked:
        limits.append(
            f"The pattern was optimised with full knowledge of {', '.join(attacked)}: a worst case for them. Detectors "
            "that the pattern was not optimised against may lose fewer vehicles; that is not measured here."
        )
    slim = [
        words.detector_name(name)
        for name, one in run.detectors.items()
        if one.get("size") == "slim"
    ]
    if slim:
        limits.append(f"{', '.join(slim)}: reduced (slim) versions, not the published networks.")
    limits.append(
        "McNemar's test treats vehicles as independent; where a tile holds many, trust the interval more."
    )
    return limits


def _flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(value, Mapping):
        return [
            pair
            for key, inner in value.items()
            for pair in _flat(inner, f"{prefix}.{key}" if prefix else str(key))
        ]
    return [(prefix, ", ".join(map(str, value)) if isinstance(value, list) else str(value))]
