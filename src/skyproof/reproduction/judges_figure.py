"""The figure of detectors that only judge: what every attack hides from each, under each renderer.

It is the counterpart of the paper's figures S2 and S3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from skyproof.report.figures import BLUE, GREY, INK, ORANGE, STYLE, as_files
from skyproof.reproduction.judges import judged_rows
from skyproof.reproduction.reproduction import Reproduction
from skyproof.words import detector_name

_RENDERERS = {"": (BLUE, "differentiable renderer"), "cycles_": (ORANGE, "Blender Cycles")}
_LOWEST = -30.0
"""Where the axis ends at the latest: intervals of rates below zero may go far."""


def judges_figure(run: Reproduction, table: str) -> dict[str, bytes]:
    """Draws a panel per judge of a table, bars with intervals; SVG and PNG by file ending."""
    judges = run.judges[table].judges
    rows = [row for row in judged_rows(run, table) if not row["attack"].startswith("R-")]
    cells = {(row["attack"], row["detector"]): row for row in rows}
    attacks = list(dict.fromkeys(row["attack"] for row in rows))
    shown = [key for key in _RENDERERS if any(f"{key}easr" in row for row in rows)]
    with plt.rc_context(STYLE | {"svg.hashsalt": f"judges-{table}"}):
        figure, grid = plt.subplots(
            1,
            len(judges),
            figsize=(2.2 + 4.4 * len(judges), 1.7 + (0.16 + 0.17 * len(shown)) * len(attacks)),
            sharey=True,
            sharex=True,
            squeeze=False,
            layout="constrained",
        )
        for axes, judge in zip(grid[0], judges, strict=True):
            for number, key in enumerate(shown):
                _bars(axes, [cells[name, judge] for name in attacks], key, number, len(shown))
            axes.set_title(detector_name(judge), loc="left", fontsize=12, fontweight="bold")
            axes.axvline(0, color=GREY, linewidth=1)
            axes.set_xlabel("EASR, % of the vehicles found before")
            axes.grid(axis="x", color="#e3e7eb")
            axes.set_axisbelow(True)
        first = grid[0][0]
        first.set_yticks(range(len(attacks)), attacks)
        first.set_ylim(len(attacks) - 0.4, -0.6)
        first.set_xlim(_left(rows, shown), 103)
        figure.legend(handles=_legend(shown), loc="outside lower center", ncols=4, fontsize=10)
        return as_files(figure)


def _bars(axes: Any, rows: Sequence[Mapping[str, Any]], key: str, number: int, count: int) -> None:
    """Draws one renderer's bars: the first above the second where there are two."""
    height = 0.8 / count
    for place, row in enumerate(rows):
        rate = row.get(f"{key}easr")
        if rate is None:
            continue
        y = place - 0.4 + height * (number + 0.5)
        axes.barh(y, rate, 0.9 * height, color=_RENDERERS[key][0], alpha=0.75, linewidth=0)
        low, high = row[f"{key}easr_low"], row[f"{key}easr_high"]
        if low is not None:
            axes.plot([low, high], [y, y], color=INK, linewidth=1.3, solid_capstyle="butt")
        random = row[f"{key}random_easr"]
        if random is not None:
            ends = [y - 0.45 * height, y + 0.45 * height]
            axes.plot([random, random], ends, color="white", linewidth=4.5, solid_capstyle="butt")
            axes.plot([random, random], ends, color=INK, linewidth=2.2, solid_capstyle="butt")


def _left(rows: Sequence[Mapping[str, Any]], shown: Sequence[str]) -> float:
    """Where the axis begins: at the lowest of what is drawn, unless that is far out."""
    drawn = [
        row.get(f"{key}{what}")
        for row in rows
        for key in shown
        for what in ("easr", "easr_low", "random_easr")
    ]
    return max(_LOWEST, min([0.0, *(value for value in drawn if value is not None)])) - 3


def _legend(shown: Sequence[str]) -> list[Any]:
    return [
        *(Patch(color=_RENDERERS[key][0], alpha=0.75, label=_RENDERERS[key][1]) for key in shown),
        Line2D([], [], color=INK, linewidth=1.3, label="95 % interval"),
        Line2D(
            [], [], color=INK, marker="|", linestyle="", markersize=11, markeredgewidth=2.2,
            label="random draws, mean",
        ),
    ]  # fmt: skip
