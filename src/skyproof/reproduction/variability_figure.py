"""The figure of one texture learnt from several starts: its maps, and how alike they are."""

from __future__ import annotations

import math

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

from skyproof.layout import Layout
from skyproof.pictures import read_pixels
from skyproof.report.figures import STYLE, as_files
from skyproof.reproduction.cells import number
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.variability import most_starts
from skyproof.words import percent

_REMEDY = "copy the whole folder again, or make the camouflage again"
_COLUMNS = 6


def variability_figure(run: Reproduction) -> dict[str, bytes]:
    """Draws the starts of the texture that has most; nothing where the run keeps no maps."""
    name = most_starts(run)
    looks = run.looks
    if name is None or looks is None:
        return {}
    layout = Layout(run.results.folder)
    starts = [
        row.name
        for row in looks.textures
        if row.name != str(name) and row.name.rpartition("-")[0] == str(name)
    ]
    paths = {start: layout.camouflage(start) / "texture.png" for start in starts}
    if not all(path.exists() for path in paths.values()):
        return {}
    alike = np.eye(len(starts))
    for pair in looks.pairs:
        if pair.first in paths and pair.second in paths:
            value = math.nan if pair.seen_correlation is None else pair.seen_correlation
            one, other = starts.index(pair.first), starts.index(pair.second)
            alike[one, other] = alike[other, one] = value
    panels = len(starts) + 1
    columns = min(panels, _COLUMNS)
    lines = math.ceil(panels / columns)
    with plt.rc_context(STYLE | {"svg.hashsalt": "variability", "font.size": 9}):
        figure, grid = plt.subplots(
            lines,
            columns,
            figsize=(2.05 * columns, 2.5 * lines),
            squeeze=False,
            layout="constrained",
        )
        for axes, (start, path) in zip(grid.flat, paths.items(), strict=False):
            axes.imshow(read_pixels(path, _REMEDY), interpolation="antialiased")
            easr = run.results.single_interval(start)
            success = "" if easr is None else f"\nEASR {percent(easr.estimate)}"
            axes.set_title(f"{start}{success}", loc="left", fontsize=9, fontweight="bold")
            axes.set_axis_off()
        axes = grid.flat[len(starts)]
        axes.imshow(alike, cmap="Blues", vmin=0, vmax=1)
        for row, column in np.ndindex(alike.shape):
            alike_here = float(alike[row, column])
            colour = "white" if alike_here > 0.6 else "black"
            text = number(alike_here, 2)
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=7)
        ticks = [start.rpartition("-")[2] for start in starts]
        axes.set_xticks(range(len(starts)), ticks)
        axes.set_yticks(range(len(starts)), ticks)
        axes.tick_params(length=0)
        axes.set_title("correlation\nof 4 × 4 texels", loc="left", fontsize=9, fontweight="bold")
        for axes in list(grid.flat)[panels:]:
            axes.set_visible(False)
        return as_files(figure)
