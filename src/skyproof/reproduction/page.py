"""The page of the paper's tables: both tables, the figure, and what backs them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.reproduction.cells import (
    Block,
    Figure,
    Grid,
    Heading,
    Table,
    bracket,
    number,
    sign,
    span,
    word,
)
from skyproof.reproduction.colours import colours_section
from skyproof.reproduction.convergence import convergence_section
from skyproof.reproduction.criteria import criteria_section
from skyproof.reproduction.cycles import ALONE, alone_on_cycles, cycles_section
from skyproof.reproduction.embeddings import embeddings_section
from skyproof.reproduction.judges import judges_section
from skyproof.reproduction.looks import looks_section
from skyproof.reproduction.order import order_section
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.trainings import trainings_section
from skyproof.reproduction.variability import variability_section
from skyproof.reproduction.weather import weather_section
from skyproof.results.results import RENDERER
from skyproof.results.rows import MAIN_MATCH
from skyproof.words import detector_name, probability

_SURE = 0.05


def paper_sections(run: Reproduction, tables: Mapping[str, Table]) -> list[Block]:
    """Says what is to be said of a reproduction beside the paper, from its tables by name."""
    detectors = ", ".join(map(detector_name, run.detectors))
    explained = " What stands “on Cycles”, and the paper’s for Blender, is explained below."
    parts: list[Block] = [
        "All rates in percent, of the test vehicles that a detector found before; mean over "
        f"{detectors}. Brackets hold 95 % intervals over background tiles, vehicles of the fleet "
        "and, where there are several, seeds of the attack and draws of the control; “repeats” the "
        "range over attacks from different seeds. “random” is the mean EASR of random draws under "
        "the same constraints, “net” the EASR minus that. “unlearnt” is the EASR of the strongest "
        "control that was chosen and not learnt (a plain paint or every vertex out, the best of "
        "many draws, a random search), and “net of it” the EASR minus that. “paper” is what the "
        "paper reports for its own renderer († only in its source’s comments)."
        + (explained if run.cycles else ""),
        Heading("Textures"),
        texture_table(tables["textures"]),
        *_shapes(tables["shape_combined"]),
        Heading("Does our order agree with the paper’s?"),
        *order_section(run, tables["agreement"]),
        *cycles_section(run, tables),
        *judges_section(run, tables),
        Heading("Can the attacks be trusted?"),
        _tests(run, [*tables["textures"].rows, *tables["shape_combined"].rows]),
        *_signs(tables["signs"]),
        *_ladder(tables["ladder"]),
        *convergence_section(tables["convergence"]),
        *_gap(tables["gap"]),
        Heading("By overlap, and false alarms"),
        *criteria_section(tables["criteria"], run),
        *_transfer(tables["transfer"], run),
        *trainings_section(run, tables),
        *weather_section(run, tables),
        *embeddings_section(run, tables),
        Heading("Practicality"),
        *_practicality(tables["practicality"]),
        *colours_section(run, tables),
        *variability_section(run, tables),
        *looks_section(),
    ]
    return [part for part in parts if part]


def texture_table(table: Table) -> Grid:
    """Gives the paper's first table."""
    header = ["attack", "practicality", *_header(table)]
    rows = [[row["attack"], sign(row["practicality"]), *_cells(row)] for row in table.rows]
    return Grid(header, rows)


def shape_table(table: Table) -> Grid:
    """Gives the paper's second table."""
    first = ["attack", "PM*", "chosen", "Pr*", "P1"]
    rows = []
    for row in table.rows:
        there = "–" if row["paper_pm_star"] is None else f"{row['paper_pm_star']:g}"
        rows.append(
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
    return Grid([*first, *_header(table), "paper PM*", "our EASR there"], rows)


def _shapes(table: Table) -> list[Block]:
    if not table.rows:
        return []
    return [
        Heading("Shape and combinations"),
        "At PM*, the magnitude with the largest P1 = 2·EASR·Pr/(EASR + Pr), Pr = 1 − PM. It is "
        "chosen on the same vehicles, so P1 is a little too high; “chosen” says in how many "
        "percent of replicates over tiles it would be. PM 0 is the texture alone.",
        shape_table(table),
        *_learnt_shapes(table),
        Figure("easr_vs_pr", "EASR against practicality"),
    ]


def _learnt_shapes(table: Table) -> list[Block]:
    """Sets combinations beside their own texture under random shapes; nothing without those."""
    rows = [
        [
            row["attack"],
            f"{row['pm_star']:g}",
            bracket(row, "easr"),
            number(row["drawn_shape_easr"]),
            bracket(row, "net_drawn_shape_easr"),
        ]
        for row in table.rows
        if row["drawn_shape_easr"] is not None
    ]
    if not rows:
        return []
    header = ["attack", "PM*", "EASR", "same texture, random shapes", "due to the learnt shape"]
    return ["What a learnt shape adds to the texture under it:", Grid(header, rows)]


def _header(table: Table) -> list[str]:
    """Heads what `_cells` makes of the table's rows."""
    ours = ["EASR", "repeats", "random", "net", "unlearnt", "net of it", "APD"]
    if "cycles_easr" in table.columns:
        return [
            *ours,
            "EASR on Cycles",
            "net on Cycles",
            "net of unlearnt on Cycles",
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
        number(row["unlearnt_easr"]),
        bracket(row, "net_unlearnt_easr"),
        number(row["apd"]),
    ]
    papers = [number(row["paper_easr"], 2) + mark]
    if "cycles_easr" in row:
        names = ("cycles_easr", "cycles_net_easr", "cycles_net_unlearnt_easr")
        alone = ALONE if alone_on_cycles(row) else ""
        cells += [bracket(row, name) + (alone if row[name] is not None else "") for name in names]
        papers.append(
            number(row["paper_easr_blender"], 2)
            + (mark if row["paper_easr_blender"] is not None else "")
        )
    return [*cells, *papers, number(row["paper_apd"], 2)]


def standing(run: Reproduction) -> str:
    """Says what the detectors score on the images without camouflage, by centres within 1 m."""
    scores = []
    for detector in run.detectors:
        row = next(
            (
                row
                for row in run.results.rows
                if (row.detector, row.renderer, row.match) == (detector, RENDERER, MAIN_MATCH)
            ),
            None,
        )
        if row is not None and row.ap_original == row.ap_original:
            scores.append(f"{detector_name(detector)} {number(100 * row.ap_original)} %")
    return ", ".join(scores)


def _tests(run: Reproduction, rows: Sequence[Mapping[str, Any]]) -> str:
    """Says what is left of chance, by interval and by test, each camouflage counted once.

    A combination whose PM* is 0 is its texture, which has a row of its own.
    """
    learnt: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        if not row["attack"].startswith("R-"):
            learnt.setdefault(run.best.get(row["attack"], row["attack"]), row)
    controlled = {n: row for n, row in learnt.items() if row["net_easr_low"] is not None}
    below = [name for name, row in controlled.items() if row["net_easr_low"] <= 0]
    single = [name for name, row in controlled.items() if row["random_draws"] == 1]
    chosen = {n: row for n, row in learnt.items() if row["net_unlearnt_easr_low"] is not None}
    unsure = [name for name, row in chosen.items() if row["net_unlearnt_easr_low"] <= 0]
    drawn = {n: row for n, row in learnt.items() if row["control_p_holm"] is not None}
    like_drawn = [name for name, row in drawn.items() if row["control_p_holm"] >= _SURE]
    tested = {n: row for n, row in learnt.items() if row["no_camouflage_p_holm"] is not None}
    like_none = [name for name, row in tested.items() if row["no_camouflage_p_holm"] >= _SURE]
    return " ".join(
        part
        for part in (
            f"Placebo: for {len(controlled) - len(below)} of {len(controlled)} distinct "
            "camouflages above, the interval of the net EASR lies above zero.",
            _named("Not surely more than an average random draw", below),
            _named("Set against a single draw, so that nothing is said of others", single),
            f"Of {len(chosen)}, {len(chosen) - len(unsure)} surely hide more than every control "
            "that was chosen and not learnt."
            if chosen
            else "",
            _named("Not surely due to learning", unsure),
            "Learnt against every draw of the random control on the same vehicles, swapped tile by "
            "tile, with Holm’s correction over the camouflages: "
            f"p < {_SURE} on every detector, for every repeat and every draw, for "
            f"{len(drawn) - len(like_drawn)} of {len(drawn)}.",
            _named("Not told from some draw on some detector", like_drawn),
            "Against no camouflage, which random patterns differ from, too (McNemar’s exact test, "
            f"corrected alike): {len(tested) - len(like_none)} of {len(tested)}.",
            _named("Not told from no camouflage on some detector", like_none),
        )
        if part
    )


def _named(what: str, names: Sequence[str]) -> str:
    return f"{what}: {', '.join(names)}." if names else ""


def _signs(table: Table) -> list[Block]:
    if not table.rows:
        return []
    lower = [row for row in table.rows if row["mean_change"] < 0]
    sure = [row for row in table.rows if row["p"] < _SURE]
    others = [row for row in table.rows if row["mean_change"] >= 0]
    text = (
        "Sign test: one step along an attack’s gradient lowered the mean score on the target in "
        f"{len(lower)} of {len(table.rows)} pairs of attack and detector; in {len(sure)} it fell "
        f"in more scenes than chance explains (exact, p < {_SURE})."
    )
    if others:
        header = ["did not fall", "detector", "scenes", "fell", "p", "mean change"]
        cells = [
            [
                row["attack"],
                row["detector"],
                str(row["scenes"]),
                str(row["fell"]),
                probability(row["p"]),
                f"{row['mean_change']:+.4f}".replace("-", "−"),
            ]
            for row in others
        ]
        return [text, Grid(header, cells)]
    return [text]


def _ladder(table: Table) -> list[Block]:
    if not table.rows:
        return []
    columns = sorted(
        (c for c in table.columns if c.startswith("after_") and c != "after_all"),
        key=lambda c: int(c[6:]),
    )
    columns.append("after_all")
    holds = sum(row["never_surely_falls"] is True for row in table.rows)
    strict = sum(row["never_falls"] is True for row in table.rows)
    text = (
        "EASR of the first repeat after so many steps. From rung to rung it never falls in "
        f"{strict} of {len(table.rows)} attacks; in {holds} no fall is certain (its 95 % interval "
        "reaches zero)."
    )
    rows = [
        [row["attack"], *(number(row.get(column)) for column in columns), word(row["never_falls"]),
         word(row["never_surely_falls"])]
        for row in table.rows
    ]  # fmt: skip
    steps = [column[6:].replace("all", "all steps") for column in columns]
    grid = Grid(["attack", *steps, "never falls", "no certain fall"], rows)
    return [Heading("Strength ladder", 3), text, grid]


def _gap(table: Table) -> list[Block]:
    rows = [
        [row["attack"], number(row["easr_before"]), number(row["easr_after"])] for row in table.rows
    ]
    if not rows:
        return []
    grid = Grid(["attack", "EASR before", "EASR after"], rows)
    return [Heading("Rounding to few colours", 3), grid]


def _transfer(table: Table, run: Reproduction) -> list[Block]:
    rows = [
        [
            row["attack"],
            ", ".join(map(detector_name, row["attacked_on"].split())),
            *(bracket(row, detector) for detector in run.detectors),
        ]
        for row in table.rows
    ]
    header = [
        "attack",
        "learnt on",
        *(f"EASR on {detector_name(detector)}" for detector in run.detectors),
    ]
    return [Heading("Transfer"), Grid(header, rows)] if rows else []


def _practicality(table: Table) -> list[Block]:
    chosen = {
        "texture_painted_area_m2": ("painted, m²", 1),
        "texture_colours": ("colours", 0),
        "texture_blocks": ("blocks", 0),
        "texture_block_roof_u_cm": ("block on the roof, cm", 0),
        "texture_boundary_m": ("boundaries, m", 0),
        "shape_added_volume_m3": ("added volume, m³", 2),
        "shape_share_self_intersecting": ("share self-intersecting", 2),
    }
    rows = [
        [
            row["attack"],
            sign(row["practicality"]),
            *(number(row.get(key), digits) for key, (_, digits) in chosen.items()),
        ]
        for row in table.rows
    ]
    if not rows:
        return []
    text = "The paper’s signs, summed, and means over the test fleet measured beside them."
    labels = [label for label, _ in chosen.values()]
    return [text, Grid(["attack", "practicality", *labels], rows)]
