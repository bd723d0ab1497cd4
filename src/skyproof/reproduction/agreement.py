"""Do our results and the paper's, or two renderers', order the attacks alike?

Rank correlations over the attacks of table 2 answer that, and the ranks themselves.
"""

import itertools
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.cells import (
    Block,
    Heading,
    Table,
    TextTable,
    Topic,
    interval_cells,
    number,
    rate,
)
from skyproof.reproduction.paper_results import ON_BLENDER, ON_RENDERER, PAPER_RESULTS
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.results.pairs.counts import OutcomeCounts
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import CYCLES, RENDERER
from skyproof.results.statistics.intervals import Interval, Sample
from skyproof.results.statistics.rates import overall_attack_success_rate

_FEWEST = 3


@dataclass(frozen=True)
class Agreement:
    """How alike two orders of the same attacks are.

    Attributes:
        attacks: names, in the second order of falling success.
        ours, theirs: EASR per attack in either order.
        spearman, kendall: rank correlations (Kendall's tau-b), 1 for the same order, −1 for the
            reverse, with the 95 % percentile interval over resampled tiles.
    """

    attacks: Sequence[str]
    ours: Sequence[float]
    theirs: Sequence[float]
    spearman: Interval
    kendall: Interval


def rank_agreement(
    tiles: OutcomeCounts,
    paper: Mapping[str, float],
    rows: Mapping[str, str] = MappingProxyType({}),
    *,
    renderer: str = RENDERER,
) -> Agreement | None:
    """Gives the rank correlation between our EASRs and the paper's over the attacks both have.

    An attack whose row is another one's, such as a combination whose best magnitude is 0, counts
    once, as that. Ours are means over repeats and detectors, and vary over resampled tiles alone.

    Args:
        tiles: our counts.
        paper: EASR by attack.
        rows: our row for an attack if its name differs, such as {"S-O": "S-O@0.4"}.
        renderer: the renderer of our counts.

    Returns:
        None for fewer than three attacks, or if an EASR is undefined.
    """
    # The paper's most successful attack comes first.
    series = _pooled(tiles, renderer)
    shared = [
        name
        for name in sorted(paper, key=lambda name: -paper[name])
        if rows.get(name, name) in series and not is_copy(name, rows, paper)
    ]
    sample = Sample.draw(tiles.cells, generator=np.random.default_rng(0))
    ours, drawn = _easr([series[rows.get(name, name)] for name in shared], sample)
    # The paper's are the same in every replicate.
    theirs = np.array([paper[name] for name in shared])
    return _agreement(shared, ours, theirs, drawn, np.tile(theirs, (len(drawn), 1)))


def is_copy(name: str, rows: Mapping[str, str], names: Collection[str]) -> bool:
    """Says whether an attack's row is that of another of these attacks."""
    row = rows.get(name, name)
    return row != name and row in names


def renderer_agreement(tiles: OutcomeCounts, names: Iterable[str]) -> Agreement | None:
    """Gives the rank correlation between the EASRs under both renderers, Cycles the second.

    Repeats that only one renderer has are left out. Both vary over the same resampled tiles.

    Args:
        tiles: counts under both.
        names: names of the attacks to compare, without repeats.

    Returns:
        None for fewer than three attacks, or if an EASR is undefined.
    """
    both = [
        all(key._replace(renderer=renderer) in tiles.series for renderer in (RENDERER, CYCLES))
        for key in tiles.series
    ]
    paired = OutcomeCounts(tiles.cells, dict(itertools.compress(tiles.series.items(), both)))
    first, second = (_pooled(paired, renderer) for renderer in (RENDERER, CYCLES))
    shared = [name for name in names if name in first and name in second]
    sample = Sample.draw(tiles.cells, generator=np.random.default_rng(0))
    ours, drawn_ours = _easr([first[name] for name in shared], sample)
    theirs, drawn_theirs = _easr([second[name] for name in shared], sample)
    # In the second renderer's order of falling success.
    order = np.argsort(-theirs, kind="stable")
    names = [shared[place] for place in order]
    return _agreement(
        names, ours[order], theirs[order], drawn_ours[:, order], drawn_theirs[:, order]
    )


def _pooled(tiles: OutcomeCounts, renderer: str) -> dict[str, list[Int[np.ndarray, "N 3"]]]:
    """Gathers the pair counts of every repeat and detector by attack."""
    series: dict[str, list[np.ndarray]] = {}
    for key, counts in tiles.series.items():
        if (key.renderer, key.match) == (renderer, MAIN_MATCH):
            series.setdefault(str(CamouflageName.read(key.camouflage).pooled), []).append(
                counts[:, 1:]
            )
    return series


def _easr(
    attacks: Sequence[Sequence[Int[np.ndarray, "N 3"]]], sample: Sample
) -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, "R A"]]:
    """The mean EASR of every attack, as it is and on the resampled tiles."""
    stacks = [np.stack(counts) for counts in attacks]
    easr = [overall_attack_success_rate(stack.sum(axis=1)).mean() for stack in stacks]
    drawn = [
        overall_attack_success_rate(sample.replicates(stack)).mean(axis=-1) for stack in stacks
    ]
    return np.array(easr), np.stack(drawn, axis=1) if drawn else np.empty((0, 0))


def _agreement(
    names: Sequence[str],
    ours: Float[np.ndarray, " A"],
    theirs: Float[np.ndarray, " A"],
    drawn_ours: Float[np.ndarray, "R A"],
    drawn_theirs: Float[np.ndarray, "R A"],
) -> Agreement | None:
    """Correlates two orders; replicates in which an EASR is undefined are left out."""
    if len(names) < _FEWEST or np.isnan(ours).any() or np.isnan(theirs).any():
        return None
    defined = ~np.isnan(drawn_ours).any(axis=1) & ~np.isnan(drawn_theirs).any(axis=1)
    estimates = rank_correlations(ours, theirs)
    drawn = rank_correlations(drawn_ours[defined], drawn_theirs[defined])
    spearman, kendall = (
        percentile_interval(float(estimate), replicates)
        for estimate, replicates in zip(estimates, drawn, strict=True)
    )
    return Agreement(names, ours.tolist(), theirs.tolist(), spearman, kendall)


def rank_correlations(
    one: Float[np.ndarray, "*R A"], other: Float[np.ndarray, "*R A"]
) -> tuple[Float[np.ndarray, "*R"], Float[np.ndarray, "*R"]]:
    """Gives Spearman's correlation and Kendall's tau-b; nan where all of one are equal.

    Args:
        one, other: one order of the same attacks in each row.
    """
    ranks = (stats.rankdata(one, axis=-1), stats.rankdata(other, axis=-1))
    deviations = (own - own.mean(axis=-1, keepdims=True) for own in ranks)
    pairs = (np.sign(values[..., :, None] - values[..., None, :]) for values in (one, other))
    flat = (own.reshape(*own.shape[:-2], -1) for own in pairs)
    return _cosine(*deviations), _cosine(*flat)


def _cosine(
    one: Float[np.ndarray, "*R K"], other: Float[np.ndarray, "*R K"]
) -> Float[np.ndarray, "*R"]:
    """Gives the cosine between rows; nan where one of them is zero."""
    products = (one * other).sum(axis=-1)
    lengths = np.sqrt((one**2).sum(axis=-1) * (other**2).sum(axis=-1))
    return np.divide(products, lengths, out=np.full_like(lengths, math.nan), where=lengths > 0)


def percentile_interval(estimate: float, drawn: Float[np.ndarray, " R"]) -> Interval:
    """Gives the percentile interval of defined replicates, widened to hold the estimate."""
    drawn = drawn[~np.isnan(drawn)]
    if len(drawn) == 0:
        return Interval(estimate, math.nan, math.nan)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(estimate, min(float(low), estimate), max(float(high), estimate))


TEXTURE = re.compile(r"[TR]-[A-Za-z]+")

_RENDERER = "our EASR and the paper’s on its renderer"
_SETS: dict[str, Callable[[str], bool]] = {
    "textures": lambda name: name.startswith("T-"),
    "textures, shape and combinations": lambda name: not name.startswith("R-"),
    "all, with random controls": lambda name: True,
}


def agreement_part(run: Reproduction) -> Topic:
    """Says how alike the orders are, and which attacks stand elsewhere."""
    rows = _rows(run)
    heading = Heading("Does our order agree with the paper’s?")
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
    return Topic([Table("agreement", rows)], [heading, *blocks])


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


def correlated(compared: str, label: str, found: Agreement | None) -> list[dict[str, Any]]:
    """Gives the row of one correlation, if there is any."""
    if found is None:
        return []
    row = {"compared": compared, "set": label, "attacks": len(found.attacks)}
    row |= interval_cells("spearman", found.spearman)
    return [row | interval_cells("kendall", found.kendall)]


def with_paper(
    run: Reproduction,
    compared: str,
    paper: Mapping[str, float],
    rows: Mapping[str, str],
    renderer: str = RENDERER,
) -> list[dict[str, Any]]:
    """Correlates our ranks under a renderer with a column of the paper's, set by set."""
    found = []
    for label, belongs in _SETS.items():
        wanted = {name: easr for name, easr in paper.items() if belongs(name)}
        agreement = rank_agreement(run.results.counts, wanted, rows, renderer=renderer)
        found += correlated(compared, label, agreement)
    return found


def _rows(run: Reproduction) -> list[dict[str, Any]]:
    """Ours with both of the paper's columns, at our PM* and at the paper's, and these together."""
    same = {
        name: point_name(name, result.perturbation_magnitude)
        for name, result in PAPER_RESULTS.items()
        if result.perturbation_magnitude is not None
    }
    at_same = with_paper(run, "the same, at the paper’s PM*", ON_RENDERER, same)
    rows = [
        *with_paper(run, _RENDERER, ON_RENDERER, run.best),
        *(row for row in at_same if row["set"] != "textures"),
        *with_paper(run, "our EASR and the paper’s on Blender", ON_BLENDER, run.best),
    ]
    # Where ours cannot be compared, the paper's own agreement is no one's question.
    if rows:
        for label, belongs in _SETS.items():
            names = [name for name in ON_BLENDER if belongs(name)]
            rows += correlated("the paper’s two columns", label, _with_itself(names))
    return rows


def _with_itself(names: Sequence[str]) -> Agreement:
    """The paper gives no intervals, so that nothing says how sure its own agreement is."""
    first, second = ([column[name] for name in names] for column in (ON_RENDERER, ON_BLENDER))
    spearman, kendall = (
        Interval(float(found), math.nan, math.nan)
        for found in rank_correlations(np.array(first), np.array(second))
    )
    return Agreement(names, first, second, spearman, kendall)


def comparison(run: Reproduction) -> dict[str, float]:
    """Gives our EASR of everything that the paper has, too, in percent; shapes at their PM*."""
    found = {name: run.row(name) for name in run.names if TEXTURE.fullmatch(name)}
    found |= {family: run.row(name) for family, name in run.best.items()}
    return {
        name: 100 * row.easr.estimate
        for name, row in found.items()
        if name in PAPER_RESULTS and row is not None and not math.isnan(row.easr.estimate)
    }


def _ranks(run: Reproduction) -> list[Block]:
    """Ranks of ours and the paper's, where they differ most on top."""
    ours = comparison(run)
    names = [
        name for name in ours if not name.startswith("R-") and not is_copy(name, run.best, ours)
    ]
    own_ranks = stats.rankdata([-ours[name] for name in names])
    paper_ranks = stats.rankdata([-PAPER_RESULTS[name].easr for name in names])
    ranks = dict(zip(names, zip(own_ranks, paper_ranks, strict=True), strict=True))
    rows = [
        [name, f"{own:g}", f"{theirs:g}", number(ours[name]), number(PAPER_RESULTS[name].easr, 2)]
        for name, (own, theirs) in sorted(
            ranks.items(), key=lambda item: -abs(item[1][0] - item[1][1])
        )
        if abs(own - theirs) > 1
    ]
    if not rows and ranks:
        return [f"None of {len(ranks)} attacks is more than one rank from its place in the paper."]
    if not rows:
        return []
    header = ["attack", "our rank", "paper’s rank", "our EASR", "paper’s EASR"]
    text = (
        f"Of {len(names)} attacks, these are two or more ranks from their place in the paper (1 is "
        "the strongest):"
    )
    return [text, TextTable(header, rows)]
