"""The paper's two tables, of textures and of shapes and combinations, and its practicality."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.agreement import TEXTURE
from skyproof.reproduction.cells import (
    Block,
    Cell,
    Figure,
    Heading,
    Table,
    TextTable,
    Topic,
    at_equal_alarms,
    equal_alarm_columns,
    in_percent,
    interval_cells,
    number,
    rate,
    sign,
    span,
    value,
)
from skyproof.reproduction.curves import curves_figure
from skyproof.reproduction.cycles import ALONE, alone_on_cycles, cycles_columns
from skyproof.reproduction.paper_results import PAPER_RESULTS, PaperResult
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.words import detector_name

Column = tuple[str, str | Cell]

_TESTS = ("control_p_holm", "strongest_control_p_holm", "no_camouflage_p_holm")


def main_part(run: Reproduction) -> Topic:
    """Returns both tables of the paper and the curves, and explains what stands in them."""
    textures = _texture_rows(run)
    shapes = _shape_rows(run)
    detectors = ", ".join(map(detector_name, run.detectors))
    explained = " The columns “on Cycles” and the paper’s for Blender are explained below."
    blocks: list[Block] = [
        "All rates in percent, of the test vehicles that a detector found before; mean over "
        f"{detectors}. Brackets hold 95 % intervals over background tiles, vehicles of the fleet "
        "and, where there are several, seeds of the attack and draws of the control; “repeats” the "
        "range over attacks from different seeds, “best repeat” the one that hid most on its own "
        "attack scenes. “random” is the mean EASR of random draws under "
        "the same constraints, “net” the EASR minus that. “best control” is the EASR of the "
        "strongest control found without optimisation (a plain paint or every vertex out, the best "
        "of N draws or patterns, a random search, any single draw, any paint of the precheck), and "
        "“net of it” the EASR minus that. “at 100/km²” are rates at thresholds with as many false "
        "alarms per km² of empty ground, else at the frozen thresholds. “held-out detectors” is "
        "the range of EASR by detectors that no attack used, at 100/km² where reached; an attack "
        "that surely beats its controls on none of them works “only at home”. “paper” is what the "
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
    tables = [Table("textures", textures), Table("shape_combined", shapes)]
    return Topic([*tables, Table("curves", _curve_rows(run))], blocks)


def texture_table(rows: Sequence[Mapping[str, Any]]) -> TextTable:
    """Returns the paper's first table."""
    signs: Column = ("practicality", lambda row: sign(row["practicality"]))
    return TextTable.of(rows, [("attack", _attack), signs, *_columns(rows)])


def shape_table(rows: Sequence[Mapping[str, Any]]) -> TextTable:
    """Returns the paper's second table."""
    return TextTable.of(
        rows,
        [
            ("attack", _attack),
            ("PM*", _magnitude("pm_star")),
            ("chosen", value("pm_star_share", 0)),
            ("Pr*", lambda row: f"{row['pr_star']:.1f}"),
            ("P1", value("p1_star", 2)),
            *_columns(rows),
            ("paper PM*", _magnitude("paper_pm_star")),
            ("our EASR there", value("easr_at_paper_pm_star")),
        ],
    )


def _learnt_shapes(shapes: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Compares combinations with their own texture under random shapes; empty without those."""
    rows = [row for row in shapes if row["drawn_shape_easr"] is not None]
    if not rows:
        return []
    grid = TextTable.of(
        rows,
        [
            ("attack", "attack"),
            ("PM*", _magnitude("pm_star")),
            ("EASR", rate("easr")),
            ("same texture, random shapes", value("drawn_shape_easr")),
            ("due to the learnt shape", rate("net_drawn_shape_easr")),
        ],
    )
    return ["What a learnt shape adds to the texture under it:", grid]


def _attack(row: Mapping[str, Any]) -> str:
    return f"{row['attack']} (only at home)" if row.get("only_at_home") else row["attack"]


def _columns(rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    """The columns that both tables have."""
    columns: list[Column] = [
        ("EASR", rate("easr")),
        ("repeats", lambda row: span(row["easr_repeat_min"], row["easr_repeat_max"])),
        ("best repeat", value("best_repeat_easr")),
        ("random", value("random_easr")),
        ("net", rate("net_easr")),
        ("best control", value("strongest_control_easr")),
        ("net of it", rate("net_strongest_control_easr")),
        *equal_alarm_columns(rows),
        ("APD", value("apd")),
    ]
    if any("outside_easr_min" in row for row in rows):
        ends = ("outside_easr_min", "outside_easr_max")
        columns.append(("held-out detectors", lambda row: span(*map(row.get, ends))))
    on_cycles = any("cycles_easr" in row for row in rows)
    if on_cycles:
        columns += [
            ("EASR on Cycles", _cycles("cycles_easr")),
            ("net on Cycles", _cycles("cycles_net_easr")),
            ("net of best control on Cycles", _cycles("cycles_net_strongest_control_easr")),
        ]
    columns.append(("paper EASR", _paper("paper_easr")))
    if on_cycles:
        columns.append(("paper Blender", _paper("paper_easr_blender")))
    return [*columns, ("paper APD", value("paper_apd", 2))]


def _magnitude(key: str) -> Cell:
    return lambda row: "–" if row[key] is None else f"{row[key]:g}"


def _cycles(key: str) -> Cell:
    def cell(row: Mapping[str, Any]) -> str:
        alone = row[key] is not None and alone_on_cycles(row)
        return rate(key)(row) + (ALONE if alone else "")

    return cell


def _paper(key: str) -> Cell:
    """The paper's number, marked if it stands only in the comments of its source."""

    def cell(row: Mapping[str, Any]) -> str:
        paper = PAPER_RESULTS.get(row["attack"])
        return number(row[key], 2) + ("†" if paper and paper.commented and row[key] else "")

    return cell


def _texture_rows(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    # Controls come last, as in the paper.
    for name in sorted(
        filter(TEXTURE.fullmatch, run.names), key=lambda name: name.startswith("R-")
    ):
        paper = PAPER_RESULTS.get(name)
        measured = run.practicality.get(CamouflageName.read(name))
        rows.append(
            {
                "attack": name,
                "practicality": None if measured is None else measured.score.total,
                **_measured(run, name),
                "paper_easr": paper.easr if paper else None,
                "paper_apd": paper.apd if paper else None,
                **_on_cycles(run, name, paper),
            }
        )
    return rows


def _shape_rows(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for family, curve in run.curves.items():
        best = curve.best
        paper = PAPER_RESULTS.get(family)
        magnitude = paper.perturbation_magnitude if paper else None
        same = next(
            (point.easr for point in curve.points if point.perturbation_magnitude == magnitude),
            None,
        )
        rows.append(
            {
                "attack": family,
                "pm_star": best.perturbation_magnitude,
                "pm_star_share": 100 * best.share_best,
                "pr_star": best.practicality,
                "p1_star": best.p1,
                **_measured(run, run.best[family]),
                "paper_pm_star": magnitude,
                "paper_easr": paper.easr if paper else None,
                "easr_at_paper_pm_star": None if same is None else 100 * same.estimate,
                "paper_apd": paper.apd if paper else None,
                **_on_cycles(run, run.best[family], paper),
            }
        )
    return rows


def _measured(run: Reproduction, name: str) -> dict[str, Any]:
    """Returns the columns that both tables have for a camouflage."""
    row = run.row(name)
    return {
        **in_percent(row),
        "best_repeat_easr": _best_repeat(run, name),
        **at_equal_alarms(run.results, row),
        **_corrected_p(run, name),
        **_outside(run, name),
    }


def _best_repeat(run: Reproduction, name: str) -> float | None:
    """EASR of the repeat that hid most on the attack's own scenes; None for a single one."""
    hidden = {
        text: record.convergence.hidden[1]
        for text, record in run.results.records.items()
        if record.convergence and str(CamouflageName.read(text).pooled) == name
    }
    if len(hidden) < 2:
        return None
    easr = run.results.single_interval(max(hidden, key=lambda text: hidden[text]))
    return None if easr is None else 100 * easr.estimate


def _corrected_p(run: Reproduction, name: str) -> dict[str, float | None]:
    """Finds by test the largest Holm-corrected p of the detectors; None where one is untested."""
    rows = [run.row(name, detector) for detector in run.detectors]
    told = [{} if row is None else row.json() for row in rows]
    found = {}
    for test in _TESTS:
        known = [row[test] for row in told if row.get(test) is not None]
        found[test] = max(known) if len(known) == len(told) else None
    return found


def _outside(run: Reproduction, name: str) -> dict[str, Any]:
    """EASR by held-out detectors, at 100 false alarms per km² where they reach them.

    An attack works only at home if it surely beats its controls on none of these detectors.
    """
    rows = []
    for results in run.held_out.values():
        for detector in results.detectors:
            row = results.row(CamouflageName.read(name), detector)
            if row is not None and not row.camouflage.random:
                rows.append(results.at(row, "100_per_km2") or row)
    rates = [100 * row.easr.estimate for row in rows if not math.isnan(row.easr.estimate)]
    if not rates:
        return {}
    beside = [row.strongest or row.random for row in rows]
    home = not any(each is not None and each.net.low > 0 for each in beside)
    return {"outside_easr_min": min(rates), "outside_easr_max": max(rates), "only_at_home": home}


def _on_cycles(run: Reproduction, name: str, paper: PaperResult | None) -> dict[str, Any]:
    """Sets the paper's Blender column beside our Cycles column."""
    ours = cycles_columns(run, name)
    theirs = {
        "paper_easr_blender": paper.easr_blender if paper else None,
        "paper_apd_blender": paper.apd_blender if paper else None,
    }
    return ours | theirs if ours else {}


def _curve_rows(run: Reproduction) -> list[dict[str, Any]]:
    return [
        {
            "attack": family,
            "pm": point.perturbation_magnitude,
            "pr": point.practicality,
            "p1": point.p1,
            "share_best": 100 * point.share_best,
            **in_percent(run.row(point_name(family, point.perturbation_magnitude))),
            **interval_cells("easr", point.easr, 100.0),
            **cycles_columns(run, point_name(family, point.perturbation_magnitude)),
        }
        for family, curve in run.curves.items()
        for point in curve.points
    ]


def practicality_part(run: Reproduction) -> Topic:
    """Returns the paper's signs, and what was measured beside them."""
    measured = _practicality_rows(run)
    tables = {"practicality": measured}
    if not measured:
        return Topic.of("Practicality", tables)
    text = "The paper’s signs, summed, and means over the test fleet measured beside them."
    grid = TextTable.of(
        measured,
        [
            ("attack", "attack"),
            ("practicality", lambda row: sign(row["practicality"])),
            ("painted, m²", value("texture_painted_area_m2")),
            ("colours", value("texture_colours", 0)),
            ("blocks", value("texture_blocks", 0)),
            ("block on the roof, cm", value("texture_block_roof_u_cm", 0)),
            ("boundaries, m", value("texture_boundary_m", 0)),
            ("added volume, m³", value("shape_added_volume_m3", 2)),
            ("share self-intersecting", value("shape_share_self_intersecting", 2)),
        ],
    )
    return Topic.of("Practicality", tables, text, grid)


def _practicality_rows(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for name, measured in run.practicality.items():
        row: dict[str, Any] = {"attack": str(name), "practicality": measured.score.total}
        for told in (measured.score, measured):
            for side in ("texture", "shape"):
                values = getattr(told, side) or {}
                row |= {f"{side}_{what}": value for what, value in values.items()}
        rows.append(row)
    return rows
