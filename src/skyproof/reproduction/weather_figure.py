"""The figure of success by weather, learnt on clear days and in all weathers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from skyproof.report.figures import BLUE, GREY, ORANGE, STYLE, as_files
from skyproof.reproduction.cells import Table
from skyproof.reproduction.weather import EVERY_WEATHER
from skyproof.results.rows import MEAN

_SERIES = (
    ("clear", "o", BLUE, -0.2, "learnt on clear days"),
    ("all", "^", ORANGE, 0.0, "learnt in all weathers"),
    ("random", "s", GREY, 0.2, "random patterns"),
)


def weather_figure(table: Table) -> dict[str, bytes]:
    """Draws one panel per attack, the mean over detectors; SVG or PNG by file ending."""
    judges = list(dict.fromkeys(row["detector"] for row in table.rows))
    wanted = MEAN if MEAN in judges else judges[0]
    panels: dict[str, list[Mapping[str, Any]]] = {}
    for row in table.rows:
        if row["detector"] == wanted:
            panels.setdefault(row["attack"], []).append(row)
    lines = max(len(rows) for rows in panels.values())
    with plt.rc_context(STYLE | {"svg.hashsalt": "weather"}):
        figure, grid = plt.subplots(
            len(panels),
            1,
            figsize=(8.5, 1.0 + (0.6 + 0.55 * lines) * len(panels)),
            layout="constrained",
            squeeze=False,
        )
        for axes, (attack, rows) in zip(grid.flat, panels.items(), strict=True):
            _panel(axes, rows)
            axes.set_title(attack, loc="left", fontsize=12, fontweight="bold")
        grid[-1, 0].set_xlabel(
            "% of the vehicles found without camouflage in that weather (bars: 95 % interval)"
        )
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=10)
        return as_files(figure)


def _panel(axes: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    lows = [0.0]
    for key, marker, colour, shift, label in _SERIES:
        for place, row in enumerate(rows):
            rate, low, high = row[key], row[f"{key}_low"], row[f"{key}_high"]
            y = place + shift
            if low == low:
                axes.plot([low, high], [y, y], color=colour, linewidth=2.2, solid_capstyle="butt")
                lows.append(low)
            if rate == rate:
                axes.plot(
                    rate,
                    y,
                    marker,
                    color=colour,
                    markersize=7,
                    markeredgecolor="white",
                    label=label if place == 0 else None,
                )
    names = [f"{row['condition'].replace('_', ' ')}\nn = {row['vehicles']}" for row in rows]
    axes.set_yticks(range(len(rows)), names, fontsize=10)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    # Clear days above, all weathers together below, and between them each by itself.
    for place, row in enumerate(rows[1:], start=1):
        if place == 1 or row["condition"] == EVERY_WEATHER:
            axes.axhline(place - 0.5, color=GREY, linewidth=0.8, linestyle="--")
    axes.axvline(0, color=GREY, linewidth=1)
    axes.set_xlim(max(min(lows), -60) - 3, 103)
    axes.grid(axis="x", color="#e3e7eb")
    axes.set_axisbelow(True)
