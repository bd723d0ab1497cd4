"""Attacks under Blender's path tracer: what becomes of their success and of random controls'."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.agreement import correlated, correlation_grid, successes, with_paper
from skyproof.reproduction.cells import (
    Block,
    TextTable,
    Topic,
    at_equal_alarms,
    in_percent,
    interval_cells,
    number,
    rate,
    value,
)
from skyproof.reproduction.paper_results import ON_BLENDER, ON_RENDERER
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import CYCLES, RENDERER, Results
from skyproof.words import detector_name

ALONE = "‡"

_COLUMNS = ("easr", "random_", "net_easr", "strongest_control", "net_strongest_control_easr", "apd")
_KINDS: Mapping[str, Callable[[str], bool]] = {
    "textures": lambda name: name.startswith("T-"),
    "shapes": lambda name: name.startswith("S-"),
    "combinations": lambda name: name.startswith("C-"),
    "all attacks": lambda name: not name.startswith("R-"),
    "random textures": lambda name: name.startswith("R-") and "-" not in name[2:],
    "random shapes and combinations": lambda name: name.startswith("R-") and "-" in name[2:],
}


def cycles_columns(run: Reproduction, name: str) -> dict[str, Any]:
    """One camouflage on Cycles and how far its EASR moved, in percent; empty without Cycles."""
    if not run.cycles:
        return {}
    found = rates_under(run.results, CamouflageName.read(name), CYCLES)
    columns = {f"cycles_{key}": value for key, value in found.items() if key.startswith(_COLUMNS)}
    change = _change(run, [name])
    return columns | {
        f"cycles_{key}": change.get(key) for key in ("change", "change_low", "change_high")
    }


def cycles_part(run: Reproduction, rows: Sequence[Mapping[str, Any]]) -> Topic:
    """Says how far EASR moves from the renderer to Cycles; `rows` are those of both tables."""
    if not run.cycles:
        return Topic()
    changes = _changes(run)
    agreements = _agreements(run)
    blocks: list[Block] = [
        "The column “on Cycles” has the same detectors, test scenes and camouflages, but the "
        "images are drawn by Blender’s path tracer Cycles instead of the differentiable renderer: "
        "light that no attack saw while it was learnt. It is the counterpart of the paper’s "
        "“Blender” column. A vehicle counts where the detector found it on Cycles’ own image "
        "without camouflage; net is minus the random control on Cycles. The net of the best "
        "control is given where Cycles has every control that the renderer has. Shapes and "
        "combinations keep the PM* that they have on the renderer.",
        _missing(run),
        _alone(rows),
        *_moves(changes),
        _placebo(rows),
    ]
    if agreements:
        blocks += [
            "Do they order the attacks alike? Rank correlations of EASR, as above; the paper’s "
            "numbers are held fixed.",
            correlation_grid(agreements),
        ]
    blocks += _originals(run)
    return Topic.of("On Cycles", {"cycles": changes, "cycles_agreement": agreements}, *blocks)


def rates_under(
    results: Results, name: CamouflageName, renderer: str, detector: str | None = None
) -> dict[str, Any]:
    """Returns a row under a renderer in percent and points; None where there is no row.

    Chosen controls count only if this renderer has all: with fewer, attacks would seem better.
    """
    row = results.row(name, detector, renderer=renderer)
    rates = in_percent(row) | at_equal_alarms(results, row)
    wanted = [control for control in name.chosen_controls if results.row(control, detector)]
    if all(results.row(control, detector, renderer=renderer) for control in wanted):
        return rates
    return rates | {key: None for key in rates if "strongest_control" in key}


def _names(run: Reproduction) -> list[str]:
    """The camouflages under both renderers, without variants and chosen controls."""
    return [
        name
        for name in run.names
        if run.row(name)
        and run.row(name, renderer=CYCLES)
        and not CamouflageName.read(name).variant
    ]


def _change(run: Reproduction, names: Collection[str]) -> dict[str, Any]:
    """Returns mean EASR under both renderers and the difference in percent, if both have these."""
    change = run.results.change([CamouflageName.read(name) for name in names])
    if change is None:
        return {}
    rates = {"easr": 100 * change.first, "cycles_easr": 100 * change.second}
    return {**rates, **interval_cells("change", change.difference, 100.0)}


def _changes(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for kind, belongs in _KINDS.items():
        names = [name for name in _names(run) if belongs(name)]
        known = [(ON_RENDERER[name], easr) for name, easr in ON_BLENDER.items() if belongs(name)]
        renderer, blender = np.mean(known, axis=0).tolist() if known else (None, None)
        if names:
            ours = {"kind": kind, "camouflages": len(names), **_change(run, names)}
            paper = {"paper_number": len(known), "paper_easr": renderer}
            rows.append(ours | paper | {"paper_easr_blender": blender})
    return rows


def _agreements(run: Reproduction) -> list[dict[str, Any]]:
    """Correlates the ranks on Cycles with the paper's Blender column and with our renderer."""
    attacks = [name for name in _names(run) if not name.startswith("R-")]
    sets = {
        "textures": [name for name in attacks if name.startswith("T-")],
        "all attacks, at every magnitude": attacks,
        "all, with random controls": _names(run),
    }
    rows = with_paper(run.results, "Cycles and the paper’s Blender", ON_BLENDER, run.best, CYCLES)
    ours, theirs = (
        successes(run.results, _names(run), renderer, paired=True)
        for renderer in (RENDERER, CYCLES)
    )
    for label, names in sets.items():
        rows += correlated("Cycles and our renderer", label, names, ours, theirs)
    return rows


def _missing(run: Reproduction) -> str:
    """Says what of the renderer's columns is not on Cycles."""
    wanted = [name for name in run.names if "_" not in name]
    left = [name for name in wanted if run.row(name, renderer=CYCLES) is None]
    text = ""
    if left:
        text = f"Not scored on Cycles yet: {len(left)} of {len(wanted)} attacks and controls. "
    names = _names(run)
    repeats, on_cycles = (
        max((row.repeats for name in names if (row := run.row(name, renderer=each))), default=0)
        for each in (RENDERER, CYCLES)
    )
    if on_cycles < repeats:
        text += (
            f"Of {repeats} repeats of an attack or draws of a control, Cycles has {on_cycles}; "
            "changes and rank correlations between the two take only those."
        )
    return text.strip()


def alone_on_cycles(row: Mapping[str, Any]) -> bool:
    """Whether a row of a table rests on one repeat on Cycles, and on several on the renderer."""
    return row["easr_repeat_min"] is not None and row["cycles_easr_repeat_min"] is None


def _alone(rows: Sequence[Mapping[str, Any]]) -> str:
    """Explains the mark of such rows; empty where there is none."""
    if not any(alone_on_cycles(row) and row["cycles_easr"] is not None for row in rows):
        return ""
    return (
        f"{ALONE} Cycles has one repeat or draw alone, where the renderer has several: the "
        "interval there allows for other starts and draws by the largest spread measured."
    )


def _moves(changes: Sequence[Mapping[str, Any]]) -> list[Block]:
    if not changes:
        return []
    text = (
        "How far EASR moves from the renderer to Cycles: means over camouflages, each the mean of "
        "its repeats and the detectors, in percent and points, paired by camouflage and tile; "
        "without controls that were chosen. Beside them the paper’s means, over the attacks for "
        "which it has both."
    )
    grid = TextTable.of(
        changes,
        [
            ("camouflages", "kind"),
            ("number", "camouflages"),
            ("EASR", value("easr")),
            ("EASR on Cycles", value("cycles_easr")),
            ("change", rate("change")),
            ("in the paper", lambda row: str(row["paper_number"] or "–")),
            ("paper EASR", value("paper_easr", 2)),
            ("paper Blender", value("paper_easr_blender", 2)),
        ],
    )
    return [text, grid]


def _placebo(rows: Sequence[Mapping[str, Any]]) -> str:
    controlled = [row for row in rows if row["cycles_net_easr_low"] is not None]
    below = [row["attack"] for row in controlled if row["cycles_net_easr_low"] <= 0]
    single = [row["attack"] for row in controlled if row["cycles_random_draws"] == 1]
    text = (
        f"Placebo on Cycles: in {len(controlled) - len(below)} of {len(controlled)} rows of the "
        "tables above, the interval of the net EASR lies above zero."
    )
    if below:
        text += f" Not surely better than chance there: {', '.join(below)}."
    if single:
        text += (
            " Compared with a single draw there, which says nothing about others: "
            f"{', '.join(single)}."
        )
    compared = [row for row in rows if row["cycles_net_strongest_control_easr_low"] is not None]
    if compared:
        above = [row for row in compared if row["cycles_net_strongest_control_easr_low"] > 0]
        text += (
            f" Against the strongest control found without optimisation, {len(above)} of "
            f"{len(compared)} do."
        )
    return text


def _originals(run: Reproduction) -> list[Block]:
    """Shows the detectors' results on the images without camouflage."""
    rows = []
    for detector in run.detectors:
        told = [_original(run, detector, renderer) for renderer in (RENDERER, CYCLES)]
        if all(told):
            cells = [cell for pair in zip(*told, strict=True) for cell in pair]
            rows.append([detector_name(detector), *cells])
    if not rows:
        return []
    header = ["detector", "AP", "AP on Cycles", "vehicles found", "vehicles found on Cycles"]
    return ["On the images without camouflage, in percent:", TextTable(header, rows)]


def _original(run: Reproduction, detector: str, renderer: str) -> tuple[str, ...]:
    """The AP and the share of vehicles found; nothing where nothing was scored."""
    for key, counts in run.results.counts.series.items():
        # Any camouflage will do: all are compared with the same original images.
        if key[1:] == (renderer, detector, MAIN_MATCH):
            vehicles, both, lost, _ = counts.sum(axis=0).tolist()
            found = 100 * (both + lost) / vehicles if vehicles else None
            return number(run.original_ap(detector, renderer)), number(found)
    return ()
