"""Rank correlations: do our results and the paper's, or two renderers', order attacks alike?"""

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.cells import Block, TextTable, Topic, interval_cells, number, rate
from skyproof.reproduction.paper_results import ON_BLENDER, ON_RENDERER, PAPER_RESULTS
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import CYCLES, RENDERER, Results
from skyproof.results.statistics.intervals import Interval, overall_attack_success_rate

TEXTURE = re.compile(r"[TR]-[A-Za-z]+")

Successes = Mapping[str, Float[np.ndarray, " _"]]
"""EASR by attack: the estimate, and after it that of every replicate, if there are any."""

_FEWEST = 3
_RENDERER = "our EASR and the paper’s on its renderer"
_SETS: dict[str, Callable[[str], bool]] = {
    "textures": lambda name: name.startswith("T-"),
    "textures, shape and combinations": lambda name: not name.startswith("R-"),
    "all, with random controls": lambda name: True,
}


def successes(
    results: Results, names: Iterable[str], renderer: str, *, paired: bool = False
) -> Successes:
    """Returns mean EASR over repeats (`paired`: of both renderers) and detectors, resampled."""
    wanted = {*names}
    every = results.counts.series
    series: dict[str, list[np.ndarray]] = {}
    for key, counts in every.items():
        name = str(CamouflageName.read(key.camouflage).pooled)
        if (key.renderer, key.match) != (renderer, MAIN_MATCH) or name not in wanted:
            continue
        if not paired or all(key._replace(renderer=each) in every for each in (RENDERER, CYCLES)):
            series.setdefault(name, []).append(counts[:, 1:])
    found = {}
    for name, own in series.items():
        stack = np.stack(own)
        sums = np.concatenate([stack.sum(axis=1)[None], results.sample.replicates(stack)])
        found[name] = overall_attack_success_rate(sums).mean(axis=-1)
    return found


def correlated(
    compared: str, label: str, names: Iterable[str], ours: Successes, theirs: Successes
) -> list[dict[str, Any]]:
    """Returns a row of rank correlations of two orders of attacks, or no row for too few attacks.

    Replicates in which an EASR is undefined are left out.
    """
    shared = [name for name in names if name in ours and name in theirs]
    if len(shared) < _FEWEST:
        return []
    one, other = np.broadcast_arrays(
        *(np.stack([each[name] for name in shared], axis=-1) for each in (ours, theirs))
    )
    defined = ~np.isnan(one + other).any(axis=1)
    if not defined[0]:
        return []
    row: dict[str, Any] = {"compared": compared, "set": label, "attacks": len(shared)}
    spearman, kendall = rank_correlations(one[defined], other[defined])
    for name, found in (("spearman", spearman), ("kendall", kendall)):
        row |= interval_cells(name, percentile_interval(float(found[0]), found[1:]))
    return [row]


def is_copy(name: str, rows: Mapping[str, str], names: Collection[str]) -> bool:
    """Says whether an attack's row is that of another of these attacks."""
    row = rows.get(name, name)
    return row != name and row in names


def rank_correlations(
    one: Float[np.ndarray, "*R A"], other: Float[np.ndarray, "*R A"]
) -> tuple[Float[np.ndarray, "*R"], Float[np.ndarray, "*R"]]:
    """Returns Spearman's correlation and Kendall's tau-b by row; nan where all of one are equal."""
    ranks = (stats.rankdata(one, axis=-1), stats.rankdata(other, axis=-1))
    deviations = (own - own.mean(axis=-1, keepdims=True) for own in ranks)
    pairs = (np.sign(values[..., :, None] - values[..., None, :]) for values in (one, other))
    flat = (own.reshape(*own.shape[:-2], -1) for own in pairs)
    return _cosine(*deviations), _cosine(*flat)


def _cosine(
    one: Float[np.ndarray, "*R K"], other: Float[np.ndarray, "*R K"]
) -> Float[np.ndarray, "*R"]:
    """Returns the cosine between rows; nan where one of them is zero."""
    products = (one * other).sum(axis=-1)
    lengths = np.sqrt((one**2).sum(axis=-1) * (other**2).sum(axis=-1))
    return np.divide(products, lengths, out=np.full_like(lengths, math.nan), where=lengths > 0)


def percentile_interval(estimate: float, drawn: Float[np.ndarray, " R"]) -> Interval:
    """Returns the percentile interval of defined replicates, widened to hold the estimate."""
    drawn = drawn[~np.isnan(drawn)]
    if len(drawn) == 0:
        return Interval(estimate, math.nan, math.nan)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(estimate, min(float(low), estimate), max(float(high), estimate))


def agreement_part(run: Reproduction) -> Topic:
    """Says how alike the orders are, and which attacks stand elsewhere."""
    rows = _rows(run)
    blocks: list[Block] = ["Fewer than three attacks can be compared."]
    if rows:
        text = (
            "Rank correlations of EASR, shapes and combinations each at their own PM* unless it "
            "says otherwise; at PM* = 0 a combination is its texture, and counts as that alone. "
            "The intervals say how far the test scenes alone could move them. The paper scored its "
            "attacks on images of its own renderer and of Blender; how alike these two columns are "
            "says what agreement can be expected."
        )
        blocks = [text, correlation_grid(rows), *_ranks(run)]
    return Topic.of("Does our order agree with the paper’s?", {"agreement": rows}, *blocks)


def correlation_grid(rows: Sequence[Mapping[str, Any]]) -> TextTable:
    """Shows rank correlations of two orders, which `rows` name as "compared" and "set"."""
    return TextTable.of(
        rows,
        [
            ("compared", "compared"),
            ("attacks", "set"),
            ("number", "attacks"),
            ("Spearman’s ρ", rate("spearman", 2)),
            ("Kendall’s τ", rate("kendall", 2)),
        ],
    )


def with_paper(
    results: Results,
    compared: str,
    paper: Mapping[str, float],
    rows: Mapping[str, str],
    renderer: str = RENDERER,
) -> list[dict[str, Any]]:
    """Correlates our EASRs under a renderer with a column of the paper's, set by set.

    `rows` has our row of an attack if its name differs, such as {"S-O": "S-O@0.4"}. An attack whose
    row is another one's, such as a combination whose best magnitude is 0, counts once, as that.
    """
    known = successes(results, [rows.get(name, name) for name in paper], renderer)
    ours = {
        name: known[rows.get(name, name)]
        for name in paper
        if rows.get(name, name) in known and not is_copy(name, rows, paper)
    }
    return _by_set(compared, ours, _fixed(paper))


def _by_set(compared: str, ours: Successes, theirs: Successes) -> list[dict[str, Any]]:
    return [
        row
        for label, belongs in _SETS.items()
        for row in correlated(compared, label, filter(belongs, ours), ours, theirs)
    ]


def _fixed(paper: Mapping[str, float]) -> Successes:
    """The paper gives no intervals: its EASRs are the same in every replicate."""
    return {name: np.array([easr]) for name, easr in paper.items()}


def _rows(run: Reproduction) -> list[dict[str, Any]]:
    """Correlates ours with the paper's columns, at our PM* and at its own, and its two columns."""
    same = {
        name: point_name(name, result.perturbation_magnitude)
        for name, result in PAPER_RESULTS.items()
        if result.perturbation_magnitude is not None
    }
    at_same = with_paper(run.results, "the same, at the paper’s PM*", ON_RENDERER, same)
    rows = [
        *with_paper(run.results, _RENDERER, ON_RENDERER, run.best),
        *(row for row in at_same if row["set"] != "textures"),
        *with_paper(run.results, "our EASR and the paper’s on Blender", ON_BLENDER, run.best),
    ]
    # How far the paper's columns agree matters only if ours can be compared.
    if rows:
        columns = (_fixed(ON_RENDERER), _fixed(ON_BLENDER))
        rows += _by_set("the paper’s two columns", *columns)
    return rows


def comparison(run: Reproduction) -> dict[str, float]:
    """Returns our EASR in percent of all attacks that the paper has, too; shapes at their PM*."""
    found = {name: run.row(name) for name in run.names if TEXTURE.fullmatch(name)}
    found |= {family: run.row(name) for family, name in run.best.items()}
    return {
        name: 100 * row.easr.estimate
        for name, row in found.items()
        if name in PAPER_RESULTS and row is not None and not math.isnan(row.easr.estimate)
    }


def _ranks(run: Reproduction) -> list[Block]:
    """Lists our ranks and the paper's, with the largest differences on top."""
    ours = comparison(run)
    names = [
        name for name in ours if not name.startswith("R-") and not is_copy(name, run.best, ours)
    ]
    own_ranks = stats.rankdata([-ours[name] for name in names])
    paper_ranks = stats.rankdata([-PAPER_RESULTS[name].easr for name in names])
    apart = [
        (abs(own - theirs), name, own, theirs)
        for name, own, theirs in zip(names, own_ranks, paper_ranks, strict=True)
        if abs(own - theirs) > 1
    ]
    if not apart:
        said = f"None of {len(names)} attacks is more than one rank from its place in the paper."
        return [said] if names else []
    rows = [
        [name, f"{own:g}", f"{theirs:g}", number(ours[name]), number(PAPER_RESULTS[name].easr, 2)]
        for _, name, own, theirs in sorted(apart, key=lambda row: -row[0])
    ]
    text = (
        f"Of {len(names)} attacks, these are two or more ranks from their place in the paper (1 is "
        "the strongest):"
    )
    header = ["attack", "our rank", "paper’s rank", "our EASR", "paper’s EASR"]
    return [text, TextTable(header, rows)]
