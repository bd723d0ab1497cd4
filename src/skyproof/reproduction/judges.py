"""Detectors that judge and were not attacked, above all those that learnt from photographs.

The counterpart of the paper's figures S2 and S3 (section S5.4).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from skyproof.camouflage.name import CamouflageName
from skyproof.layout import Layout
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Grid,
    Heading,
    Table,
    bracket,
    interval_cells,
    number,
)
from skyproof.reproduction.cycles import rates_under
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.baseline import Baseline
from skyproof.results.precheck import read_prechecks
from skyproof.results.results import CYCLES, RENDERER, Results
from skyproof.results.rows import MEAN
from skyproof.words import detector_name

_WEAK = 80.0
"""Below this AP, in percent, rates rest on the vehicles that are found at all, and say little."""

_PREFIXES = {RENDERER: "", CYCLES: "cycles_"}


def judges_tables(run: Reproduction) -> list[Table]:
    """Gives what the judges find without camouflage, and what each camouflage hides from them.

    Nothing is said of a run without judges.
    """
    if not run.judges:
        return []
    clean = [row for table in run.judges for row in _clean(run, table)]
    hidden = [row for table in run.judges for row in judged_rows(run, table)]
    return [Table("judges_clean", clean), Table("judges", hidden)]


def judges_section(run: Reproduction, tables: Mapping[str, Table]) -> list[Block]:
    """Says who judges and what is hidden from each; empty without judges."""
    if not run.judges:
        return []
    parts: list[Block] = [
        Heading("Judged by detectors that were not attacked"),
        "No attack learnt on the detectors of this section. Where these learnt from photographs, "
        "they are the counterpart of the paper’s “real” models, which its figures S2 and S3 show "
        "on Blender’s images. Scenes, camouflages, controls and statistics are those of above; "
        "shapes and combinations keep their PM*. Detectors of one table learnt from the same "
        "images; no mean goes over two tables.",
    ]
    for table in run.judges:
        clean = [row for row in tables["judges_clean"].rows if row["table"] == table]
        hidden = [row for row in tables["judges"].rows if row["table"] == table]
        parts += _table(run, table, clean, hidden)
    return parts


def judge_names(results: Results) -> list[str]:
    """Lists those who judge in one table, their mean last where there is one."""
    return [*results.judges, *([MEAN] if len(results.judges) > 1 else [])]


def judged_rows(run: Reproduction, table: str) -> list[dict[str, Any]]:
    """Gives per attack and judge of a table the rates under every renderer, in percent.

    Textures come first, then shapes and combinations at the PM* that they have in the run, then
    random textures.
    """
    results = run.judges[table]
    scored = set(map(str, results.names))
    learnt = [name for name in run.names if name.startswith("T-") and "_" not in name]
    drawn = [name for name in run.names if re.fullmatch("R-[A-Za-z]+", name)]
    names = dict.fromkeys([*learnt, *run.best.values(), *drawn])
    return [
        {"table": table, "detector": judge, "attack": name, **_rates(results, name, judge)}
        for name in names
        if name in scored
        for judge in judge_names(results)
    ]


def _rates(results: Results, name: str, judge: str) -> dict[str, Any]:
    rates: dict[str, Any] = {}
    for renderer, prefix in _PREFIXES.items():
        if renderer in results.renderers:
            found = rates_under(results, CamouflageName.read(name), renderer, judge)
            rates |= {f"{prefix}{key}": value for key, value in found.items()}
    return rates


def _clean(run: Reproduction, table: str) -> list[dict[str, Any]]:
    """Gives per judge what it finds without camouflage: in its validation, when checked, here."""
    results = run.judges[table]
    records = read_prechecks(Layout(results.folder).detectors)
    rows = []
    for judge in results.judges:
        facts = results.detectors.get(judge)
        told = {"table": table, "detector": judge}
        told["trained_on"] = facts.trained_on if facts else ""
        if facts and facts.validation.ap_centre_1m is not None:
            rows.append(
                {
                    **told,
                    "set": "its own validation",
                    "real": None,
                    "vehicles": facts.validation_vehicles,
                    "ap": 100 * facts.validation.ap_centre_1m,
                }
            )
        checked = [check for check in records[judge].sets if check.real] if judge in records else []
        here = [check for check in results.checks if check.detector == judge]
        rows += [{**told, **_check(check)} for check in (*checked, *here)]
    return rows


def _check(check: Baseline) -> dict[str, Any]:
    values: dict[str, Any] = {
        "set": check.dataset,
        "real": check.real,
        "vehicles": check.vehicles,
        "clusters": f"{check.clusters} {check.clustered_by}",
    }
    shown = {"ap": check.ap_centre_1m, "recall": check.recall, "precision": check.precision}
    for name, rate in shown.items():
        values |= interval_cells(name, rate, 100.0)
    return values


def _table(
    run: Reproduction,
    table: str,
    clean: Sequence[Mapping[str, Any]],
    hidden: Sequence[Mapping[str, Any]],
) -> list[Block]:
    results = run.judges[table]
    origins = dict.fromkeys(row["trained_on"] or "images that are not recorded" for row in clean)
    parts: list[Block] = [
        Heading(f"{table}: {', '.join(map(detector_name, results.judges))}", 3),
        f"They learnt from “{'”, “'.join(origins)}”. What they reach without camouflage, in "
        "percent; found, and right of what was reported, at the frozen threshold:",
        Grid(
            ["detector", "images", "vehicles", "AP", "found", "right"],
            [
                [
                    detector_name(row["detector"]),
                    row["set"],
                    str(row["vehicles"] or "–"),
                    *(bracket(row, name) for name in ("ap", "recall", "precision")),
                ]
                for row in clean
            ],
        ),
        _doubts(clean),
        Figure(
            f"judges-{table}",
            f"{table}: share of the vehicles found before that each attack hides (EASR), and what "
            "random draws under the same constraints hide",
        ),
    ]
    for renderer, prefix in _PREFIXES.items():
        if renderer in results.renderers:
            where = "On the differentiable renderer" if renderer == RENDERER else "On Cycles"
            rows = [row for row in hidden if row.get(f"{prefix}random_draws") == 1]
            single = ", ".join(dict.fromkeys(row["attack"] for row in rows))
            parts += [
                f"{where}: EASR, net of random draws, and net of the best unlearnt control."
                + (f" Set against a single draw: {single}." if single else ""),
                _grid(judge_names(results), hidden, prefix),
            ]
    return [part for part in parts if part]


def _doubts(clean: Sequence[Mapping[str, Any]]) -> str:
    """Says who hardly sees the vehicles of this run as they are."""
    weak = [
        f"{detector_name(row['detector'])} ({number(row['ap'], 0)} % on {row['set']})"
        for row in clean
        if row["real"] is False and not row["ap"] >= _WEAK
    ]
    if not weak:
        return ""
    return (
        f"Below an AP of {_WEAK:.0f} % without any camouflage: {', '.join(weak)}. Rates count only "
        "the vehicles that such a detector does find, often just above its threshold, where any "
        "change hides them; read the net rates."
    )


def _grid(judges: Sequence[str], hidden: Sequence[Mapping[str, Any]], prefix: str) -> Grid:
    known = {"easr": "EASR", "net_easr": "net", "net_unlearnt_easr": "net of unlearnt"}
    # What no attack has, such as chosen controls on Cycles, gets no column.
    rates = {
        key: words
        for key, words in known.items()
        if any(row.get(prefix + key) is not None for row in hidden)
    }
    cells = {(row["attack"], row["detector"]): row for row in hidden}
    names = dict.fromkeys(row["attack"] for row in hidden if row.get(f"{prefix}easr") is not None)
    header = [
        f"{detector_name(judge)}: {words}" if number == 0 else words
        for judge in judges
        for number, words in enumerate(rates.values())
    ]
    rows = [
        [name, *(bracket(cells[name, judge], prefix + key) for judge in judges for key in rates)]
        for name in names
    ]
    return Grid(["attack", *header], rows)
