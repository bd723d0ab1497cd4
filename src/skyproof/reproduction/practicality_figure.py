"""The figure of EASR against practicality.

It shows our curves with their intervals, and the paper's best points beside them.
"""

from __future__ import annotations

import math
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from skyproof.report.figures import GREY, INK, STYLE, as_files
from skyproof.reproduction.curves import Curve
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.reproduction.reproduction import Reproduction

# Okabe and Ito's colours, safe for colour-blind readers; markers differ as well.
_TEXTURES = {
    "O": (INK, "o", "original texture (S-O)"),
    "U": ("#0072B2", "s", "U"),
    "Pix": ("#56B4E9", "D", "Pix"),
    "Lc": ("#009E73", "^", "Lc"),
    "PixLc": ("#CC79A7", "v", "PixLc"),
    "Fc": ("#E69F00", "P", "Fc"),
    "PixFc": ("#D55E00", "X", "PixFc"),
}


def easr_against_practicality(run: Reproduction) -> dict[str, bytes]:
    """Draws S-O and combinations with the six textures without mask; SVG or PNG by file ending."""
    with plt.rc_context(STYLE | {"svg.hashsalt": "easr-against-practicality"}):
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(12.5, 5.6), sharey=True, layout="constrained"
        )
        for family, curve in run.curves.items():
            kind, _, texture = family.partition("-")
            texture, _, order = texture.partition("-")
            if texture not in _TEXTURES:
                continue
            if order != "par":
                _curve(left, curve, texture, "-")
                _paper(left, family, texture)
            if kind == "S" or (order and f"C-{texture}-par" in run.curves):
                _curve(right, curve, texture, "--" if order == "par" else "-")
            if order == "par":
                # The others' are in the left panel.
                _paper(right, family, texture)
        for axes, title in (
            (left, "Shape alone, and on a finished texture (seq.)"),
            (right, "In sequence or parallel"),
        ):
            axes.set_title(title, loc="left", fontsize=12, fontweight="bold")
            axes.set_xlabel("practicality Pr = 1 − PM (left: large changes of shape)")
            axes.set_xlim(-0.03, 1.03)
            axes.axhline(0, color=GREY, linewidth=0.8)
            axes.grid(color="#e3e7eb")
            axes.set_axisbelow(True)
        left.set_ylabel("EASR, % of the vehicles found before")
        left.set_ylim(top=103)
        figure.legend(handles=_legend(run), loc="outside lower center", ncols=6, fontsize=10)
        return as_files(figure)


def _curve(axes: Any, curve: Curve, texture: str, line: str) -> None:
    colour, marker, _ = _TEXTURES[texture]
    points = [point for point in curve.points if not math.isnan(point.easr.estimate)]
    places = [point.practicality for point in points]
    axes.plot(
        places,
        [100 * point.easr.estimate for point in points],
        line + marker,
        color=colour,
        linewidth=1.8,
        markersize=4.5,
        zorder=3,
    )
    if line == "-":
        band = [
            [100 * point.easr.low for point in points],
            [100 * point.easr.high for point in points],
        ]
        axes.fill_between(places, *band, color=colour, alpha=0.1, linewidth=0, zorder=1)
    best = next(point for point in curve.points if point.perturbation_magnitude == curve.best)
    axes.plot(
        best.practicality,
        100 * best.easr.estimate,
        marker,
        color=colour,
        markersize=11,
        zorder=5,
        markeredgecolor="white",
    )


def _paper(axes: Any, family: str, texture: str) -> None:
    colour, marker, _ = _TEXTURES[texture]
    paper = PAPER_RESULTS.get(family)
    if paper is None or paper.perturbation_magnitude is None:
        return
    # Fc and PixFc have nearly the same numbers.
    aside = {"Fc": -0.012, "PixFc": 0.012}.get(texture, 0.0)
    axes.plot(
        1 - paper.perturbation_magnitude + aside,
        paper.easr,
        marker,
        markerfacecolor="white",
        markeredgecolor=colour,
        markeredgewidth=1.6,
        markersize=10,
        zorder=6,
    )


def _legend(run: Reproduction) -> list[Line2D]:
    shown = {family.split("-")[1] for family in run.curves}
    handles = [
        Line2D([], [], color=colour, marker=marker, label=label)
        for texture, (colour, marker, label) in _TEXTURES.items()
        if texture in shown
    ]
    plain: dict[str, Any] = {"color": GREY, "marker": "o"}
    return [
        *handles,
        Line2D([], [], color=GREY, linestyle="--", label="in parallel (no band drawn)"),
        Line2D([], [], **plain, linestyle="", markersize=10, label="our PM* (largest P1)"),
        Line2D(
            [],
            [],
            **plain,
            linestyle="",
            markersize=10,
            markerfacecolor="white",
            label="the paper's, at its PM*",
        ),
    ]
