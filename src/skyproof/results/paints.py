"""Plain paints of the precheck, as controls of optimised camouflages."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.results.precheck import PAINTED, PrecheckRecord, Rate, rate_words
from skyproof.results.result import MAIN_MATCH, MEAN, Contrast, Result
from skyproof.results.statistics.intervals import Interval


def beside_paints(
    row: Result, prechecks: Mapping[str, PrecheckRecord], detectors: Sequence[str]
) -> Result:
    """Lets the paints of the detectors' prechecks compete for the strongest control of a row.

    Paints are measured on the attack's renderer by the main rule; other rows stay as they are, and
    so do those without a chosen control. Masked textures are compared with paints on body panels.
    Paints have the first test scenes alone: limits treat both rates as independent, p omits paints.
    """
    strongest, texture = row.strongest, row.camouflage.constraints
    names = detectors if row.detector == MEAN else [row.detector]
    known = {*names} <= {*prechecks} and (row.renderer, row.match) == ("torch", MAIN_MATCH)
    if strongest is None or texture is None or not known:
        return row
    kinds = [kind for kind in PAINTED if not (texture.masked and kind == "paint_whole")]
    paints: dict[str, list[Rate]] = {}
    for rate in (each for name in names for each in prechecks[name].rates if each.kind in kinds):
        paints.setdefault(f"plain paint {rate_words(rate)} {PAINTED[rate.kind]}", []).append(rate)
    every = [strongest]
    every += [_net(row.easr, *paint) for paint in paints.items() if len(paint[1]) == len(names)]
    best = max(every, key=lambda each: each.easr)
    low = float(np.min([each.net.low for each in every]))
    return replace(row, strongest=replace(best, net=replace(best.net, low=low), p=strongest.p))


def _net(easr: Interval, paint: str, rates: Sequence[Rate]) -> Contrast:
    """Contrasts a rate with a paint's mean over detectors, as if their limits erred together."""
    ends = [(each.easr.estimate, each.easr.low, each.easr.high) for each in rates]
    hidden = Interval(*np.mean(ends, axis=0).tolist())
    name = CamouflageName("other", random=True, label=paint)
    return Contrast(name, hidden.estimate, 1, easr.minus(hidden))
