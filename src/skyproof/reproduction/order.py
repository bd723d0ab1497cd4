"""Do we order the attacks as the paper does, and how well does the paper agree with itself?"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from scipy import stats

from skyproof.errors import ConfigurationError
from skyproof.reproduction.agreement import is_copy, rank_agreement, rank_correlations
from skyproof.reproduction.cells import Block, Grid, Table, bracket, interval_cells, number
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.reproduction.reproduction import Reproduction, point_name
from skyproof.results.statistics.intervals import Interval

TEXTURE = re.compile(r"[TR]-[A-Za-z]+")

_RENDERER = "our EASR and the paper’s on its renderer"
_SETS: dict[str, Callable[[str], bool]] = {
    "textures": lambda name: name.startswith("T-"),
    "textures, shape and combinations": lambda name: not name.startswith("R-"),
    "all, with random controls": lambda name: True,
}


def order_table(run: Reproduction) -> Table:
    """Correlates ranks: ours with both of the paper's columns, and these with each other.

    Shapes and combinations stand at our own PM*, and once more at the paper's.
    """
    renderer = {name: result.easr for name, result in PAPER_RESULTS.items()}
    blender = {
        name: result.easr_blender
        for name, result in PAPER_RESULTS.items()
        if result.easr_blender is not None
    }
    same = {
        name: point_name(name, result.perturbation_magnitude)
        for name, result in PAPER_RESULTS.items()
        if result.perturbation_magnitude is not None
    }
    rows: list[dict[str, Any]] = []
    for compared, paper, own in (
        (_RENDERER, renderer, run.best),
        ("the same, at the paper’s PM*", renderer, same),
        ("our EASR and the paper’s on Blender", blender, run.best),
        ("the paper’s two columns", blender, None),
    ):
        for label, belongs in _SETS.items():
            wanted = {name: rate for name, rate in paper.items() if belongs(name)}
            if own is same and label == "textures":
                continue
            # Where ours cannot be compared, the paper's own agreement is no one's question.
            if own is None and not rows:
                continue
            # Fewer than three attacks, or an undefined one, have no correlation.
            with suppress(ConfigurationError):
                found = _with_itself(wanted, renderer) if own is None else _with(run, wanted, own)
                rows.append({"compared": compared, "set": label, **found})
    return Table("agreement", rows)


def _with(run: Reproduction, paper: Mapping[str, float], own: Mapping[str, str]) -> dict[str, Any]:
    found = rank_agreement(run.results.tiles, paper, rows=own, generator=np.random.default_rng(0))
    return {
        "attacks": len(found.attacks),
        **interval_cells("spearman", found.spearman),
        **interval_cells("kendall", found.kendall),
    }


def _with_itself(blender: Mapping[str, float], renderer: Mapping[str, float]) -> dict[str, Any]:
    """The paper gives no intervals, so that nothing says how sure its own agreement is."""
    columns = [np.array([column[name] for name in blender]) for column in (renderer, blender)]
    spearman, kendall = map(float, rank_correlations(*columns))
    return {
        "attacks": len(blender),
        **interval_cells("spearman", Interval(spearman, math.nan, math.nan)),
        **interval_cells("kendall", Interval(kendall, math.nan, math.nan)),
    }


def order_section(run: Reproduction, table: Table) -> list[Block]:
    """Says how alike the orders are, and which attacks stand elsewhere."""
    if not table.rows:
        return ["Fewer than three attacks can be compared."]
    rows = [
        [
            row["compared"],
            row["set"],
            str(row["attacks"]),
            *(bracket(row, name, digits=2) for name in ("spearman", "kendall")),
        ]
        for row in table.rows
    ]
    text = (
        "Rank correlations of EASR, shapes and combinations each at their own PM* unless it says "
        "otherwise; at PM* = 0 a combination is its texture, and counts as that alone. The "
        "intervals say how far the test scenes alone could move them. The paper "
        "scored its attacks on images of its own renderer and of Blender; how alike these two "
        "columns are says what agreement can be expected."
    )
    header = ["compared", "attacks", "number", "Spearman’s ρ", "Kendall’s τ"]
    return [text, Grid(header, rows), *_ranks(run)]


def comparison(run: Reproduction) -> dict[str, float]:
    """Gives our EASR of everything that the paper has too, in percent.

    Textures and controls stand by their names, shapes at their PM*.
    """
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
    return [text, Grid(header, rows)]
