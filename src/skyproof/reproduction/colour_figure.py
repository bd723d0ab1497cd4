"""The figure of the colours that textures end with: small multiples of their histograms."""

from __future__ import annotations

import math
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from skyproof.report.figures import GREY, STYLE, as_files
from skyproof.reproduction.colours import CHANNELS, colour_histograms
from skyproof.reproduction.reproduction import Reproduction

_COLUMNS = 6
# Told apart by their lines, too.
_LINES: Any = (("#c0392b", "-"), ("#1e8449", "--"), ("#1f5fa8", ":"))


def colour_figure(run: Reproduction) -> dict[str, bytes]:
    """Draws a panel for every learnt texture; by file ending, nothing where not measured."""
    histograms = colour_histograms(run)
    learnt = [name for name in histograms if not name.random]
    if not learnt:
        return {}
    columns = min(_COLUMNS, len(learnt))
    lines = math.ceil(len(learnt) / columns)
    with plt.rc_context(STYLE | {"svg.hashsalt": "colours", "font.size": 9}):
        figure, grid = plt.subplots(
            lines,
            columns,
            figsize=(1.2 + 1.9 * columns, 0.9 + 1.55 * lines),
            sharex=True,
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        edges = np.linspace(0, 256, histograms[learnt[0]].shape[1] + 1)
        for axes, name in zip(grid.flat, learnt, strict=False):
            control = histograms.get(name.control)
            if control is not None:
                axes.stairs(100 * control.mean(axis=0), edges, fill=True, color="#d5dade")
            for (colour, line), channel in zip(_LINES, histograms[name], strict=True):
                axes.stairs(100 * channel, edges, color=colour, linestyle=line, linewidth=1.4)
            axes.set_title(str(name), loc="left", fontsize=9, fontweight="bold")
            axes.set_xlim(0, 256)
            axes.set_xticks([0, 128, 255])
            axes.grid(axis="y", color="#e3e7eb")
            axes.set_axisbelow(True)
        for axes in list(grid.flat)[len(learnt) :]:
            axes.set_visible(False)
        # The lowest that is drawn in its column has the values below it.
        for axes in list(grid.flat)[max(len(learnt) - columns, 0) : len(learnt)]:
            axes.tick_params(labelbottom=True)
        figure.supylabel("% of the painted surface", fontsize=10)
        figure.supxlabel("value of the channel (8 bits)", fontsize=10)
        handles: list[Any] = [
            Line2D([], [], color=colour, linestyle=line, label=channel)
            for (colour, line), channel in zip(_LINES, CHANNELS, strict=True)
        ]
        handles.append(Patch(facecolor="#d5dade", edgecolor=GREY, label="random control"))
        figure.legend(handles=handles, loc="outside upper right", ncols=4, fontsize=9)
        return as_files(figure)
