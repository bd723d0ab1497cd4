"""Success against practicality: how much shape an attack needs, and where the two balance."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.lines import Line2D

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.report.figures import GREY, INK, panels, rule
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.results.outcomes import OutcomeCounts, Series, repeat_of
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample, overall_attack_success_rate

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
# Fc and PixFc have nearly the same numbers in the paper.
_ASIDE = {"Fc": -0.012, "PixFc": 0.012}


@dataclass(frozen=True)
class Point:
    """One magnitude of a family, with the share of replicates in which its P1 is the largest."""

    perturbation_magnitude: float  # PM in [0, 1]; 0 is the family without its shape change
    easr: Interval
    p1: float
    share_best: float

    @property
    def practicality(self) -> float:
        """Pr = 1 − PM (section 3.5)."""
        return 1 - self.perturbation_magnitude


@dataclass(frozen=True)
class PracticalityCurve:
    """EASR of a family such as "C-Fc-seq" by rising magnitude; `best` is at PM*, of largest P1."""

    points: Sequence[Point]
    best: Point


def p1_score(
    easr: Float[np.ndarray, "*shape"], practicality: float | Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """P1 = 2 · EASR · Pr / (EASR + Pr), the harmonic mean; 0 where EASR ≤ 0 or Pr = 0."""
    positive = np.where(easr > 0, easr, 0.0)
    total = positive + practicality
    score = np.divide(2 * positive * practicality, total, out=np.zeros_like(total), where=total > 0)
    return np.where(np.isnan(easr), np.nan, score)


def practicality_curves(tiles: OutcomeCounts) -> dict[str, PracticalityCurve]:
    """Returns the curve of every family: names with a magnitude ("S-O@0.4"), S-O first.

    Repeats and detectors are averaged, all magnitudes on the same tiles and vehicles. Magnitude 0
    is the texture by itself: "T-Fc" for "C-Fc-seq". For "S-O" it is the vehicle as it was, EASR 0.
    """
    names = [CamouflageName.read(key.camouflage) for key in tiles.series]
    families = dict.fromkeys(
        name.family
        for name in names
        if name.magnitude is not None and not name.random and not name.variant
    )
    ordered = sorted(families, key=lambda family: family != "S-O")
    return {family: _curve(tiles, family) for family in ordered}


def _curve(tiles: OutcomeCounts, family: str) -> PracticalityCurve:
    groups = _magnitudes(tiles, family)
    scored = {frozenset(key.detector for key, _ in group) for group in groups.values()}
    if len(scored) > 1:
        raise ConfigurationError(
            f"The magnitudes of {family} were scored by different detectors; score all of them "
            "with the same."
        )
    every = [counts for group in groups.values() for _, counts in group]
    shown = np.any([counts[:, 0] > 0 for counts in every], axis=0)
    cells = [cell for cell, seen in zip(tiles.cells, shown, strict=True) if seen]
    sample = Sample.draw(cells, generator=np.random.default_rng(0))
    easr = {}
    replicates = {}
    for magnitude, series in groups.items():
        counted = np.stack([counts[shown, 1:] for _, counts in series])
        repeats = [[repeat_of(key.camouflage)] for key, _ in series]
        easr[magnitude] = mean_interval(Group(counted, sample, repeats))
        drawn = overall_attack_success_rate(sample.replicates(counted))
        replicates[magnitude] = drawn.mean(axis=-1)
    if family == "S-O":
        # Without any change every vehicle is found exactly when it was found before.
        easr[0.0] = Interval(0.0, 0.0, 0.0)
        replicates[0.0] = np.zeros(len(sample.weights))
    magnitudes = sorted(easr)
    shares = _shares_best(np.stack([p1_score(replicates[pm], 1 - pm) for pm in magnitudes]))
    points = [
        Point(pm, easr[pm], float(p1_score(np.array(easr[pm].estimate), 1 - pm)), share)
        for pm, share in zip(magnitudes, shares, strict=True)
    ]
    # Of equal scores the first counts as the largest.
    best = max(points, key=lambda point: -1.0 if math.isnan(point.p1) else point.p1)
    return PracticalityCurve(points, best)


def _magnitudes(
    tiles: OutcomeCounts, family: str
) -> Mapping[float, list[tuple[Series, Int[np.ndarray, "N 4"]]]]:
    """Gathers by magnitude the counts of every repeat and detector."""
    kind, _, rest = family.partition("-")
    # The curve of a combination starts at its texture: "T-Fc" of "C-Fc-seq".
    texture = f"T-{rest.rpartition('-')[0]}" if kind == "C" else None
    groups = defaultdict(list)
    for key, counts in tiles.series.items():
        name = CamouflageName.read(key.camouflage)
        if (key.renderer, key.match) != (RENDERER, MAIN_MATCH) or name.variant:
            continue
        if name.magnitude is not None and name.family == family:
            groups[name.magnitude].append((key, counts))
        elif name.family == texture:
            groups[0.0].append((key, counts))
    return groups


def _shares_best(scores: Float[np.ndarray, "M R"]) -> list[float]:
    """The share of replicates in which each score is the largest; of equals the first wins."""
    scores = scores[:, ~np.isnan(scores).any(axis=0)]
    if scores.shape[1] == 0:
        return [math.nan] * len(scores)
    wins = np.bincount(scores.argmax(axis=0), minlength=len(scores))
    return (wins / scores.shape[1]).tolist()


@figure_style("easr-against-practicality")
def curves_figure(curves: Mapping[str, PracticalityCurve]) -> dict[str, bytes]:
    """Draws S-O and combinations with the six textures without mask."""
    figure, grid = panels(1, 2, 12.5, 5.6, sharey=True)
    left, right = grid[0]
    for family, curve in curves.items():
        kind, _, texture = family.partition("-")
        texture, _, order = texture.partition("-")
        if texture not in _TEXTURES:
            continue
        parallel = order == "par"
        if not parallel:
            _draw_curve(left, curve, texture, "-")
        # The right panel shows S-O and the textures with both orders.
        if kind == "S" or (order and f"C-{texture}-par" in curves):
            _draw_curve(right, curve, texture, "--" if parallel else "-")
        _draw_paper(right if parallel else left, family, texture)
    left.set_title("Shape alone, and on a finished texture (seq.)")
    right.set_title("In sequence or parallel")
    for axes in (left, right):
        axes.set_xlabel("practicality Pr = 1 − PM (left: large changes of shape)")
        axes.set_xlim(-0.03, 1.03)
        axes.axhline(0, color=GREY, linewidth=0.8)
        rule(axes)
    left.set_ylabel("EASR, % of the vehicles found before")
    left.set_ylim(top=103)
    figure.legend(handles=_legend(curves), loc="outside lower center", ncols=6, fontsize=10)
    return as_files(figure)


def _draw_curve(axes: Any, curve: PracticalityCurve, texture: str, line: str) -> None:
    colour, marker, _ = _TEXTURES[texture]
    points = [point for point in curve.points if not math.isnan(point.easr.estimate)]
    places = [point.practicality for point in points]
    easr = [100 * point.easr.estimate for point in points]
    drawn = {"color": colour, "linewidth": 1.8, "markersize": 4.5, "zorder": 3}
    axes.plot(places, easr, line + marker, **drawn)
    if line == "-":
        low = [100 * point.easr.low for point in points]
        high = [100 * point.easr.high for point in points]
        axes.fill_between(places, low, high, color=colour, alpha=0.1, linewidth=0, zorder=1)
    best = curve.best
    large = {"markersize": 11, "zorder": 5, "markeredgecolor": "white"}
    axes.plot(best.practicality, 100 * best.easr.estimate, marker, color=colour, **large)


def _draw_paper(axes: Any, family: str, texture: str) -> None:
    colour, marker, _ = _TEXTURES[texture]
    paper = PAPER_RESULTS.get(family)
    if paper is None or paper.perturbation_magnitude is None:
        return
    place = 1 - paper.perturbation_magnitude + _ASIDE.get(texture, 0.0)
    hollow = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.6}
    axes.plot(place, paper.easr, marker, markersize=10, zorder=6, **hollow)


def _legend(curves: Mapping[str, PracticalityCurve]) -> list[Line2D]:
    shown = {family.split("-")[1] for family in curves}
    handles = [
        Line2D([], [], color=colour, marker=marker, label=label)
        for texture, (colour, marker, label) in _TEXTURES.items()
        if texture in shown
    ]
    large: dict[str, Any] = {"color": GREY, "marker": "o", "linestyle": "", "markersize": 10}
    return [
        *handles,
        Line2D([], [], color=GREY, linestyle="--", label="in parallel (no band drawn)"),
        Line2D([], [], **large, label="our PM* (largest P1)"),
        Line2D([], [], **large, markerfacecolor="white", label="the paper's, at its PM*"),
    ]
