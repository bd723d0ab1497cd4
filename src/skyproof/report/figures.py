"""The report's diagrams, each as one inline SVG, and its pictures as data URIs."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from PIL import Image

from skyproof.errors import StoredFileError
from skyproof.pictures import open_picture, read_pixels
from skyproof.results.conditions import Panel
from skyproof.results.outcomes import REMEDY
from skyproof.results.result import Result
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.statistics.intervals import Interval
from skyproof.results.statistics.planning import DecisionChances
from skyproof.words import detector_name

# Okabe and Ito's colours, safe for colour-blind readers; markers and line styles differ as well.
BLUE, ORANGE, GREEN, PURPLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
GREY, INK = ("#767676", "#1b2733")
_CYCLE = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (PURPLE, ":"))
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "svg.fonttype": "path",
    # Users choose names, and a "$" in one must not begin a formula.
    "text.parse_math": False,
}


def panels(lines: int, columns: int, width: float, height: float, **shared: Any) -> tuple[Any, Any]:
    """Makes a figure of a size in inches, and the grid of its axes."""
    size = (width, height)
    return plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained", **shared)


def rule(axes: Any, along: str = "both") -> None:
    """Draws a pale grid behind the data, at the ticks of one axis or of both."""
    axes.grid(axis=along, color="#e3e7eb")
    axes.set_axisbelow(True)


def forest_figure(
    salt: str, labels: Sequence[str], rows: Sequence[Result], controls: Sequence[Result | None]
) -> str:
    """Draws for each result the share hidden, and what remains after subtracting its controls."""
    randoms = [None if row is None else row.easr for row in controls]
    strongest = [None if row.strongest is None else row.strongest.net for row in rows]
    series: list[tuple[str, str, str, float, list[Interval | None]]] = [
        ("camouflage: share hidden (EASR)", "o", BLUE, -0.22, [row.easr for row in rows]),
        ("net of random controls", "D", GREEN, -0.07, [row.net_easr for row in rows]),
        ("net of the strongest control", "^", ORANGE, 0.08, strongest),
        ("random controls", "s", GREY, 0.23, randoms),
    ]
    with plt.rc_context(STYLE | {"svg.hashsalt": salt}):
        figure, axes = plt.subplots(
            figsize=(8.5, 1.3 + (0.72 if len(rows) < 9 else 0.5) * len(rows)), layout="constrained"
        )
        ends = [0.0, 1.0]
        for label, marker, colour, shift, rates in series:
            drawn = False
            for place, rate in enumerate(rates):
                if rate is None or math.isnan(rate.estimate):
                    continue
                _point(axes, rate, place + shift, marker, colour, None if drawn else label)
                ends += [rate.estimate, rate.low, rate.high]
                drawn = True
        axes.set_yticks(range(len(rows)), labels)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.axvline(0, color=GREY, linewidth=1)
        axes.set_xlim(100 * np.nanmin(ends) - 4, 100 * np.nanmax(ends) + 4)
        axes.set_xlabel("% of the vehicles found without camouflage (bars: 95 % interval)")
        rule(axes, "x")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=10)
        return as_svg(figure)


def _point(
    axes: Any,
    rate: Interval,
    place: float,
    marker: str,
    colour: str,
    label: str | None = None,
    *,
    upright: bool = False,
) -> None:
    """Draws a rate with its interval, across or upright."""
    turn = slice(None, None, -1 if upright else 1)
    if not math.isnan(rate.low):
        bar = ([100 * rate.low, 100 * rate.high], [place, place])
        axes.plot(*bar[turn], color=colour, linewidth=2.2, solid_capstyle="butt")
    spot = ([100 * rate.estimate], [place])
    style = {"color": colour, "markersize": 7, "label": label, "markeredgecolor": "white"}
    axes.plot(*spot[turn], marker, **style)


def loss_figure(title: str, curves: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Draws (step, loss) pairs, and on top of them a mean over a fiftieth of the steps."""
    with plt.rc_context(STYLE | {"svg.hashsalt": title}):
        figure, axes = plt.subplots(figsize=(5.6, 3.2), layout="constrained")
        for index, (name, points) in enumerate(curves.items()):
            colour, line = _CYCLE[index % len(_CYCLE)]
            steps, losses = np.array(points, dtype=float).T
            window = max(1, len(losses) // 50)
            smooth = np.convolve(losses, np.full(window, 1 / window), mode="valid")
            # At most 600 points: more cannot be seen, and would only make the page heavy.
            every = max(1, len(losses) // 600)
            axes.plot(steps[::every], losses[::every], color=colour, alpha=0.25, linewidth=0.8)
            axes.plot(
                steps[window - 1 :][::every],
                smooth[::every],
                line,
                color=colour,
                linewidth=1.8,
                label=detector_name(name),
            )
        if all(loss > 0 for points in curves.values() for _, loss in points):
            axes.set_yscale("log")
            # The default formatter writes formulas, which are not parsed.
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
        axes.set_xlabel("step")
        axes.set_ylabel("loss")
        axes.grid(color="#e3e7eb")
        axes.legend(fontsize=9)
        return as_svg(figure)


def condition_figure(conditions: Sequence[Panel]) -> str:
    """Draws the share hidden by condition, with intervals and numbers of vehicles."""
    lines = math.ceil(len(conditions) / 2)
    with plt.rc_context(STYLE | {"svg.hashsalt": "conditions"}):
        figure, grid = panels(lines, 2, 9.2, 2.9 * lines, sharey=True)
        for axes, panel in zip(grid.flat, conditions, strict=False):
            for place, bar in enumerate(panel.bins):
                if not math.isnan(bar.rate.estimate):
                    _point(axes, bar.rate, place, "o", BLUE, upright=True)
            labels = [f"{bar.label}\nn = {bar.vehicles}" for bar in panel.bins]
            axes.set_xticks(range(len(panel.bins)), labels, fontsize=9)
            axes.set_xlim(-0.6, len(panel.bins) - 0.4)
            axes.axhline(100 * panel.overall, color=GREY, linewidth=1, linestyle="--")
            axes.set_title(panel.title, loc="left", fontsize=11, fontweight="bold")
            rule(axes, "y")
        lows = [100 * bar.rate.low for panel in conditions for bar in panel.bins]
        bottom = min([0.0, *(low for low in lows if not math.isnan(low))])
        for axes in grid[:, 0]:
            axes.set_ylim(bottom - 3, 103)
            axes.set_ylabel("share hidden (%)")
        for axes in list(grid.flat)[len(conditions) :]:
            axes.set_visible(False)
        return as_svg(figure)


def as_svg(figure: Figure) -> str:
    """Returns a figure as SVG for embedding in a page, and closes it."""
    buffer = io.StringIO()
    figure.savefig(
        buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None}
    )
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def chances_figure(chances: DecisionChances, requirement: Requirement) -> str:
    """Draws the chances of each answer against the share lost, with the requirement's points."""
    with plt.rc_context(STYLE | {"svg.hashsalt": "acceptance"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
        undecided = 1 - chances.accepted - chances.rejected
        for label, values, line, colour, width in (
            ("accepted", chances.accepted, "-", BLUE, 2.2),
            ("rejected", chances.rejected, "--", ORANGE, 2.2),
            ("undecided", undecided, ":", GREY, 2.0),
        ):
            share = 100 * chances.shares
            axes.plot(share, 100 * values, line, color=colour, linewidth=width, label=label)
        for limit, risk, colour in (
            (requirement.accept, requirement.producer_risk, ORANGE),
            (requirement.reject, requirement.consumer_risk, BLUE),
        ):
            axes.axvline(100 * limit, color="#c6cdd4", linewidth=1, zorder=0)
            axes.plot([100 * limit], [100 * risk], "v", color=colour, markersize=8)
        axes.set_xlim(0, min(100, 250 * requirement.reject))
        axes.set_ylim(-2, 102)
        axes.set_xlabel("% of the found vehicles that the detector loses")
        axes.set_ylabel("% of such tests")
        axes.grid(color="#e3e7eb")
        axes.legend(fontsize=10, loc="center right")
        return as_svg(figure)


@dataclass(frozen=True)
class QueryCurve:
    """The share hidden against the number of queries, of an attack or its random search."""

    name: str
    points: Sequence[tuple[int, Interval]]
    random: bool


def queries_figure(curves: Sequence[QueryCurve]) -> str:
    """Draws a panel per attack, its random search dashed."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    with plt.rc_context(STYLE | {"svg.hashsalt": "queries"}):
        width = max(4.0, 2.7 * columns)
        figure, grid = panels(rows, columns, width, 0.5 + 2.3 * rows, sharex=True, sharey=True)
        for axes, name in zip(grid.flat, names, strict=False):
            for curve in (one for one in curves if one.name == name):
                colour, line = (GREY, "s--") if curve.random else (BLUE, "o-")
                label = "random search" if curve.random else "query attack"
                images = [count for count, _ in curve.points]
                rates = [(rate.estimate, rate.low, rate.high) for _, rate in curve.points]
                shares, lows, highs = 100 * np.array(rates).T
                axes.plot(images, shares, line, color=colour, markersize=5, label=label)
                axes.fill_between(images, lows, highs, color=colour, alpha=0.15, linewidth=0)
            axes.set_title(name, fontsize=11)
            axes.grid(color="#e3e7eb")
        for axes in list(grid.flat)[len(names) :]:
            axes.set_visible(False)
        figure.supxlabel("images shown to the detector", fontsize=11)
        figure.supylabel("% hidden", fontsize=11)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=10)
        return as_svg(figure)


def embedded_jpeg(path: Path) -> str:
    """Returns a JPEG file as a data URI."""
    with open_picture(path, REMEDY) as picture:
        if picture.format != "JPEG":
            raise StoredFileError(f"{path} is a {picture.format} file, not JPEG; {REMEDY}.")
    return f"data:image/jpeg;base64,{base64.b64encode(path.read_bytes()).decode()}"


def embedded(path: Path, *, lossless: bool = True, largest_px: int = 4096) -> str:
    """Returns a picture as a data URI, reduced if larger: PNG where texels matter, else JPEG."""
    buffer = io.BytesIO()
    picture = Image.fromarray(read_pixels(path, REMEDY))
    picture.thumbnail((largest_px, largest_px))
    kind = "png" if lossless else "jpeg"
    # PNG ignores the quality, and JPEG is not optimised.
    picture.save(buffer, kind, optimize=lossless, quality=80)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
