"""Success of query attacks against the number of queries."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt

from skyproof.report.figures import BLUE, GREY, STYLE, as_svg
from skyproof.results.statistics.intervals import Interval

_WIDTH_IN = 2.7
_ROW_IN = 2.3
_COLUMNS = 3


@dataclass(frozen=True)
class QueryCurve:
    """The share hidden against the number of queries, of an attack or its random search."""

    name: str
    points: Sequence[tuple[int, Interval]]
    random: bool


def queries_figure(curves: Sequence[QueryCurve]) -> str:
    """Draws a panel per attack, its random search dashed."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    columns = min(_COLUMNS, len(names))
    rows = math.ceil(len(names) / columns)
    with plt.rc_context(STYLE | {"svg.hashsalt": "queries"}):
        figure, grid = plt.subplots(
            rows,
            columns,
            figsize=(max(4.0, _WIDTH_IN * columns), 0.5 + _ROW_IN * rows),
            sharex=True,
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        for axes, name in zip(grid.flat, names, strict=False):
            for curve in (one for one in curves if one.name == name):
                colour, line = (GREY, "s--") if curve.random else (BLUE, "o-")
                images = [count for count, _ in curve.points]
                axes.plot(
                    images,
                    [100 * rate.estimate for _, rate in curve.points],
                    line,
                    color=colour,
                    markersize=5,
                    label="random search" if curve.random else "query attack",
                )
                axes.fill_between(
                    images,
                    [100 * rate.low for _, rate in curve.points],
                    [100 * rate.high for _, rate in curve.points],
                    color=colour,
                    alpha=0.15,
                    linewidth=0,
                )
            axes.set_title(name, fontsize=11)
            axes.grid(color="#e3e7eb")
        for axes in list(grid.flat)[len(names) :]:
            axes.set_visible(False)
        figure.supxlabel("images shown to the detector", fontsize=11)
        figure.supylabel("% hidden", fontsize=11)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=10)
        return as_svg(figure)
