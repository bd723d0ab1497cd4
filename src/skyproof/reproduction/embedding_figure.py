"""The figure of detectors' features in two dimensions: PCA and t-SNE side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from skyproof.camouflage.name import CamouflageName
from skyproof.report.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, STYLE, as_files
from skyproof.reproduction.cells import Table
from skyproof.reproduction.embeddings import EVERY, shown_name
from skyproof.reproduction.stored_features import GROUND
from skyproof.results.pairs.outcomes import ORIGINAL
from skyproof.words import detector_name


def embedding_figure(points: Table, numbers: Table) -> dict[str, bytes]:
    """Draws one line of two pictures per camouflage and detector; SVG or PNG by file ending."""
    shares = {
        (row["camouflage"], row["detector"]): row["pca_share"]
        for row in numbers.rows
        if row["shown"] == EVERY
    }
    lines: dict[tuple[str, str], list[Any]] = {}
    for row in points.rows:
        lines.setdefault((row["camouflage"], row["detector"]), []).append(row)
    several = len({camouflage for camouflage, _ in lines}) > 1
    with plt.rc_context(STYLE | {"svg.hashsalt": "embeddings"}):
        figure, grid = plt.subplots(
            len(lines), 2, figsize=(10.5, 0.7 + 4.3 * len(lines)), layout="constrained",
            squeeze=False,
        )  # fmt: skip
        for (left, right), ((camouflage, detector), rows) in zip(grid, lines.items(), strict=True):
            share = f"PCA ({shares[camouflage, detector]:.0f} % of the variance)"
            for axes, name, title in ((left, "pca", share), (right, "tsne", "t-SNE")):
                _scatter(axes, rows, name)
                told = f"{detector_name(detector)}, {title}"
                axes.set_title(
                    f"{camouflage}: {told}" if several else told,
                    loc="left",
                    fontsize=12,
                    fontweight="bold",
                )
        shown = dict.fromkeys(row["shown"] for row in points.rows)
        figure.legend(
            handles=[_handle(each) for each in shown],
            loc="outside lower center",
            ncols=3,
            fontsize=11,
        )
        return as_files(figure)


def _scatter(axes: Any, rows: Sequence[Any], name: str) -> None:
    """Draws all points in a fixed random order, so that no class lies on top of the others."""
    order = np.random.default_rng(0).permutation(len(rows))
    places = np.array([[row[f"{name}_1"], row[f"{name}_2"]] for row in rows])
    for start in range(0, len(order), 40):
        part = order[start : start + 40]
        for shown in dict.fromkeys(rows[index]["shown"] for index in part):
            own = [index for index in part if rows[index]["shown"] == shown]
            colour, marker = _style(shown)
            axes.plot(
                places[own, 0],
                places[own, 1],
                marker,
                color=colour,
                markersize=4.5,
                alpha=0.75,
                markeredgecolor="white",
                markeredgewidth=0.3,
            )
    axes.set_xlabel("first component" if name == "pca" else "")
    axes.set_ylabel("second component" if name == "pca" else "")
    # Neither plane has a unit that could be read off.
    axes.set_xticks([])
    axes.set_yticks([])


def _style(shown: str) -> tuple[str, str]:
    """Okabe and Ito's colours, safe for colour-blind readers; markers differ as well."""
    if shown in (GROUND, ORIGINAL):
        return {GROUND: (GREY, "s"), ORIGINAL: (BLUE, "o")}[shown]
    name = CamouflageName.read(shown)
    if name.choice == "plain":
        return GREEN, "v"
    return (PURPLE, "D") if name.random else (ORANGE, "^")


def _handle(shown: str) -> Line2D:
    colour, marker = _style(shown)
    label = shown_name(shown)
    return Line2D([], [], color=colour, marker=marker, linestyle="", markersize=7, label=label)
