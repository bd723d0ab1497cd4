"""The paper's two tables, of textures and of shapes and combinations, with our numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.reproduction.agreement import TEXTURE
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Grid,
    Heading,
    Part,
    Table,
    bracket,
    in_percent,
    number,
    sign,
    span,
)
from skyproof.reproduction.curves import curves_figure
from skyproof.reproduction.cycles import ALONE, alone_on_cycles, cycles_columns
from skyproof.reproduction.paper_results import PAPER_RESULTS, PaperResult
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.words import detector_name


def main_part(run: Reproduction) -> Part:
    """Gives both tables of the paper and the curves, and explains what stands in them."""
    textures = _texture_rows(run)
    shapes = _shape_rows(run)
    detectors = ", ".join(map(detector_name, run.detectors))
    explained = " The columns “on Cycles” and the paper’s for Blender are explained below."
    blocks: list[Block] = [
        "All rates in percent, of the test vehicles that a detector found before; mean over "
        f"{detectors}. Brackets hold 95 % intervals over background tiles, vehicles of the fleet "
        "and, where there are several, seeds of the attack and draws of the control; “repeats” the "
        "range over attacks from different seeds. “random” is the mean EASR of random draws under "
        "the same constraints, “net” the EASR minus that. “best control” is the EASR of the "
        "strongest control found without optimisation (a plain paint or every vertex out, the best "
        "of N draws, a random search), and “net of it” the EASR minus that. “paper” is what the "
        "paper reports for its own renderer († only in its source’s comments)."
        + (explained if run.cycles else ""),
        Heading("Textures"),
        texture_table(textures),
    ]
    if shapes:
        blocks += [
            Heading("Shape and combinations"),
            "At PM*, the magnitude with the largest P1 = 2·EASR·Pr/(EASR + Pr), Pr = 1 − PM. It is "
            "chosen on the same vehicles, so P1 is a little too high; “chosen” says in how many "
            "percent of replicates over tiles it would be. PM 0 is the texture alone.",
            shape_table(shapes),
            *_learnt_shapes(shapes),
            Figure("easr_vs_pr", "EASR against practicality", curves_figure(run.curves)),
        ]
    named = {"textures": textures, "shape_combined": shapes, "curves": _curve_rows(run)}
    return Part([Table(name, rows) for name, rows in named.items()], blocks)


def texture_table(rows: Sequence[Mapping[str, Any]]) -> Grid:
    """Gives the paper's first table."""
    header = ["attack", "practicality", *_header(rows)]
    cells = [[row["attack"], sign(row["practicality"]), *_cells(row)] for row in rows]
    return Grid(header, cells)


def shape_table(rows: Sequence[Mapping[str, Any]]) -> Grid:
    """Gives the paper's second table."""
    first = ["attack", "PM*", "chosen", "Pr*", "P1"]
    cells = []
    for row in rows:
        there = "–" if row["paper_pm_star"] is None else f"{row['paper_pm_star']:g}"
        cells.append(
            [
                row["attack"],
                f"{row['pm_star']:g}",
                number(row["pm_star_share"], 0),
                f"{row['pr_star']:.1f}",
                number(row["p1_star"], 2),
                *_cells(row),
                there,
                number(row["easr_at_paper_pm_star"]),
            ]
        )
    return Grid([*first, *_header(rows), "paper PM*", "our EASR there"], cells)


def _learnt_shapes(shapes: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Sets combinations beside their own texture under random shapes; nothing without those."""
    rows = [
        [
            row["attack"],
            f"{row['pm_star']:g}",
            bracket(row, "easr"),
            number(row["drawn_shape_easr"]),
            bracket(row, "net_drawn_shape_easr"),
        ]
        for row in shapes
        if row["drawn_shape_easr"] is not None
    ]
    if not rows:
        return []
    header = ["attack", "PM*", "EASR", "same texture, random shapes", "due to the learnt shape"]
    return ["What a learnt shape adds to the texture under it:", Grid(header, rows)]


def _header(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Heads what `_cells` makes of the table's rows."""
    ours = ["EASR", "repeats", "random", "net", "best control", "net of it", "APD"]
    if "cycles_easr" in Table("", rows).columns:
        return [
            *ours,
            "EASR on Cycles",
            "net on Cycles",
            "net of best control on Cycles",
            "paper EASR",
            "paper Blender",
            "paper APD",
        ]
    return [*ours, "paper EASR", "paper APD"]


def _cells(row: Mapping[str, Any]) -> list[str]:
    paper = PAPER_RESULTS.get(row["attack"])
    mark = "†" if paper and paper.commented else ""
    cells = [
        bracket(row, "easr"),
        span(row["easr_repeat_min"], row["easr_repeat_max"]),
        number(row["random_easr"]),
        bracket(row, "net_easr"),
        number(row["strongest_control_easr"]),
        bracket(row, "net_strongest_control_easr"),
        number(row["apd"]),
    ]
    papers = [number(row["paper_easr"], 2) + mark]
    if "cycles_easr" in row:
        names = ("cycles_easr", "cycles_net_easr", "cycles_net_strongest_control_easr")
        alone = ALONE if alone_on_cycles(row) else ""
        cells += [bracket(row, name) + (alone if row[name] is not None else "") for name in names]
        papers.append(
            number(row["paper_easr_blender"], 2)
            + (mark if row["paper_easr_blender"] is not None else "")
        )
    return [*cells, *papers, number(row["paper_apd"], 2)]


def _texture_rows(run: Reproduction) -> list[dict[str, Any]]:
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


def _shape_rows(run: Reproduction) -> list[dict[str, Any]]:
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


def _curve_rows(run: Reproduction) -> list[dict[str, Any]]:
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
