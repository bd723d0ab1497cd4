"""Attacks from several starts: how alike their textures are, and whom they hide (section S7)."""

import itertools
import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.name import CamouflageName
from skyproof.pictures import read_pixels
from skyproof.report.figures import panels
from skyproof.reproduction.agreement import percentile_interval
from skyproof.reproduction.cells import (
    Figure,
    TextTable,
    Topic,
    interval_cells,
    number,
    rate,
    value,
)
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored import PairLooks
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER
from skyproof.results.statistics.intervals import UNDEFINED, Interval
from skyproof.words import percent

_LIKENESS = ("correlation", "distance", "seen_correlation", "seen_distance")
_REMEDY = "copy the whole folder again, or make the camouflage again"
_COLUMNS = 6
_MISSING = "How alike repeats of an attack are was not measured in this run."


def variability_part(run: Reproduction) -> Topic:
    """Says how alike textures from several starts are, if that was measured."""
    pairs = _pairs(run)
    learnt = [name for name in pairs if not name.random]
    if not learnt:
        return Topic.of("From several starts", {}, _MISSING)
    rows: list[dict[str, Any]] = []
    starts: list[dict[str, Any]] = []
    for name in learnt:
        names = dict.fromkeys(each for pair in pairs[name] for each in (pair.first, pair.second))
        row = {"attack": str(name), "starts": len(names), **_likeness("", pairs[name])}
        row |= _likeness("random_", pairs.get(name.control, []))
        if agreed := _agreement(run, names):
            row |= interval_cells("agreement", agreed)
        rows.append(row)
        for each in names:
            easr = run.results.single_interval(each)
            starts.append({"attack": each, **(interval_cells("easr", easr, 100.0) if easr else {})})
    # The texture that was learnt from most starts; the first of equals.
    most = max(learnt, key=lambda name: len(pairs[name]))
    own = [row for row in starts if _pooled(row["attack"]) == most]
    return Topic.of(
        "From several starts",
        {"variability": rows, "starts": starts},
        "How alike the textures are that one attack ends with from different seeds, over all "
        "pairs of them: correlation of the texels (per channel, mean of the three; 0 where they "
        "have nothing to do with each other) and mean distance of their colours in CIELAB (ΔE; "
        "2.3 can just be noticed), each texel by its area on the test vehicles. “of 4 × 4” is the "
        "same of blocks of 4 × 4 texels averaged in linear light, which is what the renderer reads "
        "most: an attack hardly tells finer detail from what it was drawn as. “random” is the same "
        "among draws of the random control. “hidden alike” correlates, over the vehicles that a "
        "detector found before, which of them two starts hide (mean over pairs and detectors; 95 % "
        "interval over background tiles); it is undefined where a start hides all.",
        TextTable.of(
            rows,
            [
                ("texture", "attack"),
                ("starts", "starts"),
                ("correlation of texels", partial(_mean, key="correlation", digits=2)),
                ("random", value("random_correlation", 2)),
                ("correlation of 4 × 4", partial(_mean, key="seen_correlation", digits=2)),
                ("random", value("random_seen_correlation", 2)),
                ("ΔE of texels", partial(_mean, key="distance", digits=0)),
                ("random", value("random_distance", 0)),
                ("ΔE of 4 × 4", partial(_mean, key="seen_distance", digits=0)),
                ("random", value("random_seen_distance", 0)),
                ("hidden alike", rate("agreement", 2)),
            ],
        ),
        f"The starts of {most} one by one, with intervals over tiles and vehicles:",
        TextTable.of(own, [("start", "attack"), ("EASR, %", rate("easr"))]),
        Figure(
            "variability",
            f"{most} from its starts, each as its map (nose up, roof in the middle, the underside, "
            "which nobody sees, at both sides), and the correlations of 4 × 4 texels between them",
            _figure(run, most),
        ),
    )


def _pooled(camouflage: str) -> CamouflageName:
    return CamouflageName.read(camouflage).pooled


def _pairs(run: Reproduction) -> dict[CamouflageName, list[PairLooks]]:
    """Gathers the pairs of repeats by texture, optimised or random."""
    found = defaultdict(list)
    for pair in run.looks.pairs if run.looks else ():
        found[_pooled(pair.first)].append(pair)
    return found


def _likeness(prefix: str, pairs: Sequence[PairLooks]) -> dict[str, Any]:
    """Means and extremes over pairs; None where undefined."""
    row: dict[str, Any] = {}
    for key in _LIKENESS:
        values = [value for pair in pairs if (value := getattr(pair, key)) is not None]
        row[f"{prefix}{key}"] = fmean(values) if values else None
        row[f"{prefix}{key}_min"] = min(values, default=None)
        row[f"{prefix}{key}_max"] = max(values, default=None)
    return row


def _mean(row: Mapping[str, Any], key: str, digits: int) -> str:
    low, high = row[f"{key}_min"], row[f"{key}_max"]
    if row["starts"] < 3 or low is None:
        return number(row[key], digits)
    return f"{number(row[key], digits)} ({number(low, digits)} to {number(high, digits)})"


def _agreement(run: Reproduction, names: Collection[str]) -> Interval | None:
    """Correlates which vehicles two starts hide, mean over pairs and detectors, tiles resampled.

    Placements of one fleet vehicle on one tile count together, by the share of them hidden.
    """
    by_detector = defaultdict(list)
    for key, counts in run.results.counts.series.items():
        if key.camouflage in names and (key.renderer, key.match) == (RENDERER, MAIN_MATCH):
            by_detector[key.detector].append(counts)
    sums = [
        _sums(first, second)
        for series in by_detector.values()
        for first, second in itertools.combinations(series, 2)
    ]
    if not sums:
        return None
    stacked = np.stack(sums)
    whole = _correlations(stacked.sum(axis=1))
    if np.isnan(whole).all():
        return UNDEFINED
    # Averages the pairs whose correlation is defined, the same ones in every replicate.
    known = ~np.isnan(whole)
    halves = np.split(stacked[known], 2, axis=-1)
    sums_drawn = np.concatenate([run.results.sample.replicates(half) for half in halves], axis=-1)
    drawn = _correlations(sums_drawn).mean(axis=-1)
    return percentile_interval(float(whole[known].mean()), drawn)


def _sums(
    first: Int[np.ndarray, "N 4"], second: Int[np.ndarray, "N 4"]
) -> Float[np.ndarray, "N 6"]:
    """Returns per cell the sums for correlating two hidden shares, weighted by vehicles found."""
    found = (first[:, 1] + first[:, 2]).astype(float)
    one, other = (counts[:, 2] / np.maximum(found, 1) for counts in (first, second))
    columns = (np.ones_like(found), one, other, one**2, other**2, one * other)
    return np.stack([found * column for column in columns], axis=1)


def _correlations(sums: Float[np.ndarray, "*S 6"]) -> Float[np.ndarray, "*S"]:
    """Returns Pearson's correlations; nan where one side does not vary."""
    count, one, other, ones, others, products = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        together = products / count - one * other / count**2
        spread = (ones / count - (one / count) ** 2) * (others / count - (other / count) ** 2)
        return np.where(spread > 1e-12, together / np.sqrt(spread), np.nan)


@figure_style("variability", font=9, title=9)
def _figure(run: Reproduction, name: CamouflageName) -> dict[str, bytes]:
    """Draws the starts of one texture; nothing where the run keeps no maps."""
    assert run.looks is not None
    starts = [
        row.name
        for row in run.looks.textures
        if row.name != str(name) and row.name.rpartition("-")[0] == str(name)
    ]
    paths = [run.layout.camouflage(start) / "texture.png" for start in starts]
    if not all(path.exists() for path in paths):
        return {}
    alike = np.eye(len(starts))
    for pair in run.looks.pairs:
        if pair.first in starts and pair.second in starts:
            correlation = math.nan if pair.seen_correlation is None else pair.seen_correlation
            one, other = starts.index(pair.first), starts.index(pair.second)
            alike[one, other] = alike[other, one] = correlation
    count = len(starts) + 1
    columns = min(count, _COLUMNS)
    lines = math.ceil(count / columns)
    figure, grid = panels(lines, columns, 2.05 * columns, 2.5 * lines)
    for axes, start, path in zip(grid.flat, starts, paths, strict=False):
        axes.imshow(read_pixels(path, _REMEDY), interpolation="antialiased")
        easr = run.results.single_interval(start)
        axes.set_title(start if easr is None else f"{start}\nEASR {percent(easr.estimate)}")
        axes.set_axis_off()
    axes = grid.flat[len(starts)]
    axes.imshow(alike, cmap="Blues", vmin=0, vmax=1)
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7}
    for row, column in np.ndindex(alike.shape):
        correlation = float(alike[row, column])
        colour = "white" if correlation > 0.6 else "black"
        axes.text(column, row, number(correlation, 2), color=colour, **centred)
    ticks = [start.rpartition("-")[2] for start in starts]
    axes.set_xticks(range(len(starts)), ticks)
    axes.set_yticks(range(len(starts)), ticks)
    axes.tick_params(length=0)
    axes.set_title("correlation\nof 4 × 4 texels")
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    return as_files(figure)
