"""Detectors that no attack used (section S5.4), as in the paper's figures S2 and S3."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from skyproof.camouflage.name import CamouflageName
from skyproof.report.figures import BLUE, GREY, INK, ORANGE, panels, rule
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Heading,
    TextTable,
    Topic,
    detector_of,
    interval_cells,
    number,
    rate,
)
from skyproof.reproduction.cycles import rates_under
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.reproduction import Reproduction
from skyproof.results.operating_points import EQUAL_ALARMS
from skyproof.results.result import MEAN
from skyproof.results.results import CYCLES, RENDERER, Results
from skyproof.results.score_folder import Baseline
from skyproof.words import detector_name

_WEAK = 80.0
"""AP in percent below which rates rest on few vehicles."""

_PREFIXES = {RENDERER: "", CYCLES: "cycles_"}
_DRAWN = {"": (BLUE, "differentiable renderer"), "cycles_": (ORANGE, "Blender Cycles")}
_RATES = {
    "easr": "EASR",
    "net_easr": "net",
    "net_strongest_control_easr": "net of best control",
    **{f"easr_at_{point}": f"EASR at {alarms}/km²" for point, alarms in EQUAL_ALARMS.items()},
}
_LOWEST = -30.0
"""Lowest left end of the axis, because intervals of rates may reach far below zero."""


def held_out_part(run: Reproduction) -> Topic:
    """Returns what held-out detectors find without camouflage, and what is hidden from them."""
    if not run.held_out:
        return Topic()
    blocks: list[Block] = [
        "No attack learnt on the detectors of this section. Where these learnt from photographs, "
        "they are the counterpart of the paper’s “real” models, which its figures S2 and S3 show "
        "on Blender’s images. Scenes, camouflages, controls and statistics are those of above; "
        "shapes and combinations keep their PM*. Detectors of one table learnt from the same "
        "images; no mean goes over two tables.",
    ]
    baselines: list[dict[str, Any]] = []
    hidden: list[dict[str, Any]] = []
    for table in run.held_out:
        own_baselines = _baselines(run, table)
        own_hidden = held_out_rows(run, table)
        blocks += _table(run, table, own_baselines, own_hidden)
        baselines += own_baselines
        hidden += own_hidden
    tables = {"judges_clean": baselines, "judges": hidden}
    return Topic.of("Judged by detectors that were not attacked", tables, *blocks)


def detectors_and_mean(results: Results) -> list[str]:
    """The detectors of one table, their mean last if there are several."""
    return [*results.detectors, *([MEAN] if len(results.detectors) > 1 else [])]


def held_out_rows(run: Reproduction, table: str) -> list[dict[str, Any]]:
    """Returns the rates of each attack and detector of a table, by renderer, in percent."""
    results = run.held_out[table]
    scored = set(map(str, results.names))
    learnt = [name for name in run.names if name.startswith("T-") and "_" not in name]
    drawn = [name for name in run.names if re.fullmatch("R-[A-Za-z]+", name)]
    names = dict.fromkeys([*learnt, *run.best.values(), *drawn])
    return [
        {"table": table, "detector": detector, "attack": name, **_rates(results, name, detector)}
        for name in names
        if name in scored
        for detector in detectors_and_mean(results)
    ]


def _rates(results: Results, name: str, detector: str) -> dict[str, Any]:
    rates: dict[str, Any] = {}
    for renderer, prefix in _PREFIXES.items():
        if renderer in results.renderers:
            found = rates_under(results, CamouflageName.read(name), renderer, detector)
            rates |= {f"{prefix}{key}": value for key, value in found.items()}
    return rates


def _baselines(run: Reproduction, table: str) -> list[dict[str, Any]]:
    """The baselines of each detector: in its validation, in its precheck, and here."""
    results = run.held_out[table]
    rows = []
    for detector in results.detectors:
        facts = results.cards.get(detector)
        trained_on = facts.trained_on if facts else ""
        told = {"table": table, "detector": detector, "trained_on": trained_on}
        if facts and "ap_centre_1m" in facts.validation:
            own = {"set": "its own validation", "real": None, "vehicles": facts.validation_vehicles}
            rows.append(told | own | {"ap": 100 * facts.validation["ap_centre_1m"]})
        record = results.prechecks.get(detector)
        real = [check for check in record.sets if check.real] if record else []
        ours = [check for check in results.baselines if check.detector == detector]
        here = [check for check in ours if check.vehicles]
        rows += [told | _check(check) for check in (*real, *here)]
    return rows


def _check(check: Baseline) -> dict[str, Any]:
    return {
        "set": check.dataset,
        "real": check.real,
        "vehicles": check.vehicles,
        "clusters": f"{check.clusters} {check.clustered_by}",
        **interval_cells("ap", check.ap_centre_1m, 100.0),
        **interval_cells("recall", check.recall, 100.0),
        **interval_cells("precision", check.precision, 100.0),
    }


def _table(
    run: Reproduction,
    table: str,
    baselines: Sequence[Mapping[str, Any]],
    hidden: Sequence[Mapping[str, Any]],
) -> list[Block]:
    results = run.held_out[table]
    unknown = "images that are not recorded"
    origins = dict.fromkeys(row["trained_on"] or unknown for row in baselines)
    parts: list[Block] = [
        Heading(f"{table}: {', '.join(map(detector_name, results.detectors))}", 3),
        f"They learnt from “{'”, “'.join(origins)}”. What they reach without camouflage, in "
        "percent; found, and right of what was reported, at the frozen threshold:",
        TextTable.of(
            baselines,
            [
                ("detector", detector_of),
                ("images", "set"),
                ("vehicles", lambda row: str(row["vehicles"] or "–")),
                ("AP", rate("ap")),
                ("found", rate("recall")),
                ("right", rate("precision")),
            ],
        ),
        _doubts(baselines),
        Figure(
            f"judges-{table}",
            f"{table}: share of the vehicles found before that each attack hides (EASR), and what "
            "random draws under the same constraints hide",
            _figure(table, results.detectors, hidden),
        ),
    ]
    for renderer, prefix in _PREFIXES.items():
        if renderer in results.renderers:
            where = "On the differentiable renderer" if renderer == RENDERER else "On Cycles"
            rows = [row for row in hidden if row.get(f"{prefix}random_draws") == 1]
            single = ", ".join(dict.fromkeys(row["attack"] for row in rows))
            parts += [
                f"{where}: EASR, net of random draws, and net of the best control."
                + (f" Set against a single draw: {single}." if single else ""),
                _grid(detectors_and_mean(results), hidden, prefix),
            ]
    return [part for part in parts if part]


def _doubts(baselines: Sequence[Mapping[str, Any]]) -> str:
    """Names the detectors with a weak baseline on this run's vehicles."""
    weak = [
        f"{detector_name(row['detector'])} ({number(row['ap'], 0)} % on {row['set']})"
        for row in baselines
        if row["real"] is False and not row["ap"] >= _WEAK
    ]
    if not weak:
        return ""
    return (
        f"Below an AP of {_WEAK:.0f} % without any camouflage: {', '.join(weak)}. Rates count only "
        "the vehicles that such a detector does find, often just above its threshold, where any "
        "change hides them; read the net rates."
    )


def _grid(detectors: Sequence[str], hidden: Sequence[Mapping[str, Any]], prefix: str) -> TextTable:
    # Rates that no attack has, such as net of chosen controls on Cycles, get no column.
    rates = {
        prefix + key: words
        for key, words in _RATES.items()
        if any(row.get(prefix + key) is not None for row in hidden)
    }
    cells = {(row["attack"], row["detector"]): row for row in hidden}
    names = dict.fromkeys(row["attack"] for row in hidden if row.get(f"{prefix}easr") is not None)
    header = ["attack"]
    for detector in detectors:
        first, *others = rates.values()
        header += [f"{detector_name(detector)}: {first}", *others]
    rows = [
        [name, *(rate(key)(cells[name, detector]) for detector in detectors for key in rates)]
        for name in names
    ]
    return TextTable(header, rows)


def _figure(
    table: str, detectors: Sequence[str], hidden: Sequence[Mapping[str, Any]]
) -> dict[str, bytes]:
    """Draws a panel per detector of a table, bars with intervals."""
    rows = [row for row in hidden if not row["attack"].startswith("R-")]
    cells = {(row["attack"], row["detector"]): row for row in rows}
    attacks = list(dict.fromkeys(row["attack"] for row in rows))
    shown = [prefix for prefix in _DRAWN if any(f"{prefix}easr" in row for row in rows)]
    height = 1.7 + (0.16 + 0.17 * len(shown)) * len(attacks)
    with figure_style(f"judges-{table}"):
        figure, grid = panels(
            1, len(detectors), 2.2 + 4.4 * len(detectors), height, sharey=True, sharex=True
        )
        for axes, detector in zip(grid[0], detectors, strict=True):
            for number, prefix in enumerate(shown):
                own = [cells[name, detector] for name in attacks]
                _bars(axes, own, prefix, number, 0.8 / len(shown))
            axes.set_title(detector_name(detector))
            axes.axvline(0, color=GREY, linewidth=1)
            axes.set_xlabel("EASR, % of the vehicles found before")
            rule(axes, "x")
        first = grid[0][0]
        first.set_yticks(range(len(attacks)), attacks)
        first.set_ylim(len(attacks) - 0.4, -0.6)
        first.set_xlim(_left(rows, shown), 103)
        figure.legend(handles=_legend(shown), loc="outside lower center", ncols=4, fontsize=10)
        return as_files(figure)


def _bars(
    axes: Any, rows: Sequence[Mapping[str, Any]], prefix: str, number: int, height: float
) -> None:
    """Draws one renderer's bars: the first above the second where there are two."""
    for place, row in enumerate(rows):
        if row.get(f"{prefix}easr") is None:
            continue
        y = place - 0.4 + height * (number + 0.5)
        colour, _ = _DRAWN[prefix]
        axes.barh(y, row[f"{prefix}easr"], 0.9 * height, color=colour, alpha=0.75, linewidth=0)
        lines = []
        limits = [row[f"{prefix}easr_low"], row[f"{prefix}easr_high"]]
        if limits[0] is not None:
            lines.append((limits, [y, y], INK, 1.3))
        random = row[f"{prefix}random_easr"]
        if random is not None:
            ends = [y - 0.45 * height, y + 0.45 * height]
            lines += [([random] * 2, ends, "white", 4.5), ([random] * 2, ends, INK, 2.2)]
        for across, down, line, width in lines:
            axes.plot(across, down, color=line, linewidth=width, solid_capstyle="butt")


def _left(rows: Sequence[Mapping[str, Any]], shown: Sequence[str]) -> float:
    """Returns where the axis begins: at the lowest value drawn, unless that is far out."""
    keys = [prefix + key for prefix in shown for key in ("easr", "easr_low", "random_easr")]
    drawn = [row[key] for row in rows for key in keys if row.get(key) is not None]
    return max(_LOWEST, min([0.0, *drawn])) - 3


def _legend(shown: Sequence[str]) -> list[Any]:
    tick: dict[str, Any] = {"marker": "|", "markersize": 11, "markeredgewidth": 2.2}
    return [
        *(
            Patch(color=colour, alpha=0.75, label=label)
            for colour, label in map(_DRAWN.__getitem__, shown)
        ),
        Line2D([], [], color=INK, linewidth=1.3, label="95 % interval"),
        Line2D([], [], color=INK, linestyle="", label="random draws, mean", **tick),
    ]
