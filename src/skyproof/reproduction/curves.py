"""Success against practicality: how much shape an attack needs, and where the two balance."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.report.figures import GREY, INK, STYLE, as_files
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.results.pairs.counts import OutcomeCounts, Series, repeat_of
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER
from skyproof.results.statistics.contrasts import Group, mean_interval
from skyproof.results.statistics.intervals import Interval, Sample
from skyproof.results.statistics.rates import overall_attack_success_rate


@dataclass(frozen=True)
class Point:
    """One perturbation magnitude of a family.

    Attributes:
        perturbation_magnitude: PM in [0, 1]; 0 is the family without its shape change.
        easr: mean over repeats and detectors with its interval.
        p1: of `easr` and practicality Pr = 1 − PM.
        share_best: in how many of the replicates, over tiles, this magnitude has the largest P1.
    """

    perturbation_magnitude: float
    easr: Interval
    p1: float
    share_best: float

    @property
    def practicality(self) -> float:
        """Pr = 1 − PM (section 3.5)."""
        return 1 - self.perturbation_magnitude


@dataclass(frozen=True)
class PracticalityCurve:
    """EASR against practicality of one family.

    Attributes:
        family: "S-O", "C-Fc-seq", ...
        points: by rising magnitude.
        best: PM*, the magnitude of the largest P1; the smallest of equals.
    """

    family: str
    points: Sequence[Point]
    best: float


def p1_score(
    easr: Float[np.ndarray, "*shape"], practicality: float | Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Gives P1 = 2 · EASR · Pr / (EASR + Pr), the harmonic mean; 0 where EASR ≤ 0 or Pr = 0.

    nan stays nan.
    """
    easr = np.asarray(easr, dtype=np.float64)
    practicality = np.asarray(practicality, dtype=np.float64)
    positive = np.where(easr > 0, easr, 0.0)
    total = positive + practicality
    score = np.divide(2 * positive * practicality, total, out=np.zeros_like(total), where=total > 0)
    return np.where(np.isnan(easr), np.nan, score)


def curve_families(tiles: OutcomeCounts) -> list[str]:
    """Lists the families that have a curve: names with a magnitude ("S-O@0.4").

    Controls and variants have none.
    """
    names = [CamouflageName.read(key.camouflage) for key in tiles.series]
    return list(
        dict.fromkeys(
            name.family
            for name in names
            if name.magnitude is not None and not name.random and not name.variant
        )
    )


def practicality_curve(
    tiles: OutcomeCounts,
    family: str,
    *,
    generator: np.random.Generator,
) -> PracticalityCurve:
    """Gives the curve of one family over the magnitudes that were scored.

    Repeats and detectors are averaged; all magnitudes on the same tiles and vehicles. Magnitude 0
    is the texture by itself: "T-Fc" for "C-Fc-seq". For "S-O" it is the vehicle as it was, whose
    EASR is 0 by definition.

    Args:
        tiles: counts of the magnitudes, and of the texture where the family has one.
        family: name before "@".
        generator: of the bootstrap.

    Raises:
        ConfigurationError: nothing of the family was scored, or a detector scored only some of its
            magnitudes.
    """
    groups = _magnitudes(tiles, family)
    if not groups or set(groups) == {0.0}:
        raise ConfigurationError(
            f"Nothing of {family} was scored; score {family}@0.1, {family}@0.2, ..."
        )
    scored = {magnitude: {key.detector for key, _ in group} for magnitude, group in groups.items()}
    if len({frozenset(names) for names in scored.values()}) > 1:
        raise ConfigurationError(
            f"The magnitudes of {family} were scored by different detectors; score all of them "
            "with the same."
        )
    every = [counts for group in groups.values() for _, counts in group]
    shown = np.any([counts[:, 0] > 0 for counts in every], axis=0)
    cells = [cell for cell, seen in zip(tiles.cells, shown, strict=True) if seen]
    sample = Sample.draw(cells, generator=generator)
    stacks = {
        pm: Group(
            np.stack([counts[shown, 1:] for _, counts in groups[pm]]),
            sample,
            [[repeat_of(key.camouflage)] for key, _ in groups[pm]],
        )
        for pm in sorted(groups)
    }
    easr = {pm: mean_interval(group) for pm, group in stacks.items()}
    replicates = {
        pm: overall_attack_success_rate(sample.replicates(group.counts)).mean(axis=-1)
        for pm, group in stacks.items()
    }
    if family == "S-O":
        # Without any change every vehicle is found exactly when it was found before.
        easr[0.0] = Interval(0.0, 0.0, 0.0)
        replicates[0.0] = np.zeros(len(sample.weights))
    magnitudes = sorted(easr)
    p1 = [float(p1_score(np.array(easr[pm].estimate), 1 - pm)) for pm in magnitudes]
    shares = _shares_best(np.stack([p1_score(replicates[pm], 1 - pm) for pm in magnitudes]))
    points = [
        Point(pm, easr[pm], score, share)
        for pm, score, share in zip(magnitudes, p1, shares, strict=True)
    ]
    best = max(
        points,
        key=lambda point: (
            -1.0 if math.isnan(point.p1) else point.p1,
            -point.perturbation_magnitude,
        ),
    )
    return PracticalityCurve(family, points, best.perturbation_magnitude)


def _magnitudes(
    tiles: OutcomeCounts, family: str
) -> Mapping[float, list[tuple[Series, Int[np.ndarray, "N 4"]]]]:
    """Gathers by magnitude the counts of every repeat and detector."""
    groups: dict[float, list[tuple[Series, Int[np.ndarray, "N 4"]]]] = {}
    for key, counts in tiles.series.items():
        if (key.renderer, key.match) != (RENDERER, MAIN_MATCH):
            continue
        name = CamouflageName.read(key.camouflage)
        if name.variant:
            continue
        if name.magnitude is not None and name.family == family:
            groups.setdefault(name.magnitude, []).append((key, counts))
        elif name.family == _texture_of(family):
            groups.setdefault(0.0, []).append((key, counts))
    return groups


def _texture_of(family: str) -> str | None:
    """Gives the texture at which the curve of a combination starts: "T-Fc" of "C-Fc-seq"."""
    kind, _, rest = family.partition("-")
    return f"T-{rest.rpartition('-')[0]}" if kind == "C" else None


def _shares_best(scores: Float[np.ndarray, "M R"]) -> list[float]:
    """Gives per magnitude the share of replicates in which its score is the largest.

    Of equal scores the first wins.
    """
    scores = scores[:, ~np.isnan(scores).any(axis=0)]
    if scores.shape[1] == 0:
        return [math.nan] * len(scores)
    return [
        float(share)
        for share in np.bincount(scores.argmax(axis=0), minlength=len(scores)) / scores.shape[1]
    ]


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


def curves_figure(curves: Mapping[str, PracticalityCurve]) -> dict[str, bytes]:
    """Draws S-O and combinations with the six textures without mask; SVG or PNG by file ending."""
    with plt.rc_context(STYLE | {"svg.hashsalt": "easr-against-practicality"}):
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(12.5, 5.6), sharey=True, layout="constrained"
        )
        for family, curve in curves.items():
            kind, _, texture = family.partition("-")
            texture, _, order = texture.partition("-")
            if texture not in _TEXTURES:
                continue
            if order != "par":
                _draw_curve(left, curve, texture, "-")
                _draw_paper(left, family, texture)
            if kind == "S" or (order and f"C-{texture}-par" in curves):
                _draw_curve(right, curve, texture, "--" if order == "par" else "-")
            if order == "par":
                # The others' are in the left panel.
                _draw_paper(right, family, texture)
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
        figure.legend(handles=_legend(curves), loc="outside lower center", ncols=6, fontsize=10)
        return as_files(figure)


def _draw_curve(axes: Any, curve: PracticalityCurve, texture: str, line: str) -> None:
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


def _draw_paper(axes: Any, family: str, texture: str) -> None:
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


def _legend(curves: Mapping[str, PracticalityCurve]) -> list[Line2D]:
    shown = {family.split("-")[1] for family in curves}
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
