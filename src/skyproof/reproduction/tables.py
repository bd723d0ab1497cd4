"""The tables of a reproduction: our numbers, in percent, beside the paper's."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.cells import Table, in_percent, interval_cells
from skyproof.reproduction.colours import colour_tables
from skyproof.reproduction.convergence import convergence_table
from skyproof.reproduction.criteria import criteria_table
from skyproof.reproduction.cycles import cycles_columns, cycles_tables
from skyproof.reproduction.embeddings import embeddings_tables
from skyproof.reproduction.judges import judges_tables
from skyproof.reproduction.order import TEXTURE, order_table
from skyproof.reproduction.paper_results import PAPER_RESULTS, PaperResult
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.reproduction.trainings import trainings_tables
from skyproof.reproduction.transfer import transfer_matrix
from skyproof.reproduction.variability import variability_tables
from skyproof.reproduction.weather import weather_tables
from skyproof.results.stored import Discretisation

_RUNG = re.compile(r"(?P<base>.+)_step(?P<step>\d+)-(?P<repeat>\d+)")


def reproduction_tables(run: Reproduction) -> dict[str, Table]:
    """Makes all tables by name."""
    made = [
        Table("textures", _textures(run)),
        Table("shape_combined", _shapes(run)),
        Table("curves", _curves(run)),
        order_table(run),
        *cycles_tables(run),
        *judges_tables(run),
        criteria_table(run),
        *trainings_tables(run),
        Table("practicality", _practicality(run)),
        Table("transfer", _transfer(run)),
        Table("ladder", _ladder(run)),
        convergence_table(run),
        Table("signs", _signs(run)),
        Table("gap", _gap(run)),
        *embeddings_tables(run),
        *weather_tables(run),
        *colour_tables(run),
        *variability_tables(run),
    ]
    return {table.name: table for table in made}


def _textures(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    # Controls come last, as in the paper.
    for name in sorted(
        filter(TEXTURE.fullmatch, run.names), key=lambda name: name.startswith("R-")
    ):
        paper = PAPER_RESULTS.get(name)
        measured = run.practicality(name)
        rows.append(
            {
                "attack": name,
                "practicality": None if measured is None else measured.score.total,
                **in_percent(run.row(name)),
                **run.corrected_p(name),
                "paper_easr": paper.easr if paper else None,
                "paper_apd": paper.apd if paper else None,
                **_on_cycles(run, name, paper),
            }
        )
    return rows


def _shapes(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for family, curve in run.curves.items():
        best = next(point for point in curve.points if point.perturbation_magnitude == curve.best)
        paper = PAPER_RESULTS.get(family)
        magnitude = paper.perturbation_magnitude if paper else None
        same = next(
            (point.easr for point in curve.points if point.perturbation_magnitude == magnitude),
            None,
        )
        rows.append(
            {
                "attack": family,
                "pm_star": curve.best,
                "pm_star_share": 100 * best.share_best,
                "pr_star": best.practicality,
                "p1_star": best.p1,
                **in_percent(run.row(run.best[family])),
                **run.corrected_p(run.best[family]),
                "paper_pm_star": magnitude,
                "paper_easr": paper.easr if paper else None,
                "easr_at_paper_pm_star": None if same is None else 100 * same.estimate,
                "paper_apd": paper.apd if paper else None,
                **_on_cycles(run, run.best[family], paper),
            }
        )
    return rows


def _on_cycles(run: Reproduction, name: str, paper: PaperResult | None) -> dict[str, Any]:
    """Sets the paper's Blender column beside our Cycles column."""
    ours = cycles_columns(run, name)
    if not ours:
        return {}
    return {
        **ours,
        "paper_easr_blender": paper.easr_blender if paper else None,
        "paper_apd_blender": paper.apd_blender if paper else None,
    }


def _curves(run: Reproduction) -> list[dict[str, Any]]:
    return [
        {
            "attack": family,
            "pm": point.perturbation_magnitude,
            "pr": point.practicality,
            "p1": point.p1,
            "share_best": 100 * point.share_best,
            **in_percent(run.row(point_name(family, point.perturbation_magnitude))),
            "easr": 100 * point.easr.estimate,
            "easr_low": 100 * point.easr.low,
            "easr_high": 100 * point.easr.high,
            **cycles_columns(run, point_name(family, point.perturbation_magnitude)),
        }
        for family, curve in run.curves.items()
        for point in curve.points
    ]


def _practicality(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for name, measured in run.results.practicality.items():
        score = measured.score
        signs = {"texture": score.texture, "shape": score.shape}
        quantities = {"texture": measured.texture or {}, "shape": measured.shape or {}}
        flat = {
            f"{side}_{what}": value
            for told in (signs, quantities)
            for side, values in told.items()
            for what, value in values.items()
        }
        rows.append({"attack": str(name), "practicality": score.total, **flat})
    return rows


def _transfer(run: Reproduction) -> list[dict[str, Any]]:
    """Sets the detectors attacked (rows) against those that judged (columns)."""
    names = run.results.names
    variants = [name for name in names if name.variant.startswith(("on_", "without_"))]
    attacked = {
        CamouflageName.read(name): tuple(record.attack.detectors)
        for name, record in run.records.items()
        if record.attack is not None
    }
    rows = []
    for base in dict.fromkeys(name.base for name in variants):
        # Copies kept on the way are variants too, but not of what was attacked.
        matrix = transfer_matrix(
            [row for row in run.results.rows if row.camouflage in (base, *variants)],
            attacked,
            base=base,
        )
        for cells in matrix:
            row: dict[str, Any] = {"attack": str(base), "attacked_on": " ".join(cells[0].attacked)}
            for cell in cells:
                row |= interval_cells(cell.detector, cell.easr, 100.0)
            rows.append(row)
    return rows


def _ladder(run: Reproduction) -> list[dict[str, Any]]:
    """Gives EASR of one repeat after some of its steps and after all; does it get weaker?"""
    rungs: dict[str, dict[int, str]] = {}
    for key in run.results.tiles.series:
        if found := _RUNG.fullmatch(key.camouflage):
            rungs.setdefault(f"{found['base']}-{found['repeat']}", {})[int(found["step"])] = (
                key.camouflage
            )
    rows = []
    for name, steps in rungs.items():
        ladder = [(str(step), steps[step]) for step in sorted(steps)] + [("all", name)]
        easr = {
            f"after_{label}": run.results.single_easr(camouflage) for label, camouflage in ladder
        }
        changes = [
            run.results.difference(later, earlier)
            for (_, earlier), (_, later) in itertools.pairwise(ladder)
        ]
        known = [value for value in easr.values() if value is not None]
        rows.append(
            {
                "attack": name,
                **{label: None if value is None else 100 * value for label, value in easr.items()},
                "never_falls": None if len(known) < len(easr) else _rises(known),
                # A fall counts where its whole interval lies below zero.
                "never_surely_falls": None
                if any(change is None for change in changes)
                else not any(change is not None and change.high < 0 for change in changes),
            }
        )
    return rows


def _rises(values: Sequence[float]) -> bool:
    return all(later >= earlier for earlier, later in itertools.pairwise(values))


def _signs(run: Reproduction) -> list[dict[str, Any]]:
    return [
        {"attack": name, "detector": detector, **found}
        for name, record in run.records.items()
        for detector, found in (record.sign_test or {}).items()
    ]


def _gap(run: Reproduction) -> list[dict[str, Any]]:
    """Gives EASR and losses of attacks on few colours, before the last rounding and after it."""
    rows = []
    for key in dict.fromkeys(key.camouflage for key in run.results.tiles.series):
        if "_relaxed-" not in key:
            continue
        name = key.replace("_relaxed-", "-")
        before = run.results.single_easr(key)
        after = run.results.single_easr(name)
        row: dict[str, Any] = {
            "attack": name,
            "easr_before": None if before is None else 100 * before,
            "easr_after": None if after is None else 100 * after,
        }
        record = run.records.get(name)
        losses = record.discretisation if record else Discretisation()
        for when, means in (("before", losses.before), ("after", losses.after)):
            row |= {f"loss_{detector}_{when}": value for detector, value in means.items()}
        rows.append(row)
    return rows
