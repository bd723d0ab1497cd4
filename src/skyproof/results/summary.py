"""From counts to the table of results: one row per camouflage, renderer, detector and match criterion, and means."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.names import is_control, matched_control, pooled_name
from skyproof.results.pairs.outcomes import MATCHES
from skyproof.results.pairs.sets import ORIGINAL, SetScore
from skyproof.results.pairs.tiles import Series, TileCounts
from skyproof.results.statistics.intervals import (
    Interval,
    cluster_interval,
    holm,
    mcnemar_p,
    mean_interval,
    resample,
)
from skyproof.results.statistics.rates import (
    attack_success_rate,
    enhancement_rate,
    overall_attack_success_rate,
    success_difference,
)

__all__ = ["MEAN", "summarise"]

MEAN = "mean"


def summarise(
    tiles: TileCounts, sets: Sequence[SetScore], *, generator: np.random.Generator
) -> list[dict[str, Any]]:
    """The rows of `results.json`: fractions, with None where undefined (PAPER 34, 37-41).

    Repeats of one camouflage ("T-U-0", "T-U-1": seeds of an attack, draws of a control) share one row: the mean over
    repeats, and over detectors in row "mean" (unweighted, PAPER 39; undefined where one detector found no vehicle
    before). Net EASR is a row's EASR minus its random control's. All of it on the same resampled tiles, so the
    intervals cover which scenes were drawn, for these very repeats; how the repeats spread is said beside them by
    `easr_repeat_sd` (sample standard deviation), `easr_repeat_min` and `easr_repeat_max`, None with one repeat.

    `mcnemar_p` is the largest over the repeats, and 1 where some lose vehicles on balance and others gain them, so that
    what it claims holds for every repeat. Holm's correction runs over the detectors' rows of one match criterion,
    controls excluded.

    Args:
        tiles: counts of every camouflage, renderer, detector and match.
        sets: average precision and false alarms of every set, "original" included; missing ones give None.
        generator: of the bootstrap.
    """
    rows: list[dict[str, Any]] = []
    scores = {Series(s.camouflage, s.renderer, s.detector, s.match): s for s in sets}
    for match in MATCHES:
        for renderer in _unique(key.renderer for key in tiles.series if key.match == match):
            here = {
                key: counts
                for key, counts in tiles.series.items()
                if key[1] == renderer and key[3] == match
            }
            rows.extend(_Table(here, scores, generator).rows(renderer, match))
    for match in MATCHES:
        tested = [row for row in rows if row["match"] == match and row["mcnemar_p"] is not None]
        for row, corrected in zip(tested, holm([row["mcnemar_p"] for row in tested]), strict=True):
            row["mcnemar_p_holm"] = corrected
    return rows


class _Table:
    """The counts of one renderer and one match criterion, and their rows."""

    def __init__(
        self,
        series: Mapping[Series, Int[np.ndarray, "C 4"]],
        scores: Mapping[Series, SetScore],
        generator: np.random.Generator,
    ) -> None:
        shown = np.any([counts[:, 0] > 0 for counts in series.values()], axis=0)
        self.counts = {
            (key.camouflage, key.detector): counts[shown, 1:] for key, counts in series.items()
        }
        self.vehicles = {
            (key.camouflage, key.detector): int(counts[:, 0].sum())
            for key, counts in series.items()
        }
        self.tiles = {
            (key.camouflage, key.detector): int((counts[:, 0] > 0).sum())
            for key, counts in series.items()
        }
        self.detectors = _unique(key.detector for key in series)
        self.repeats: dict[str, list[str]] = defaultdict(list)
        for camouflage in _unique(key.camouflage for key in series):
            self.repeats[pooled_name(camouflage)].append(camouflage)
        self.scores = scores
        self.weights = resample(int(shown.sum()), generator=generator)

    def rows(self, renderer: str, match: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for name, members in self.repeats.items():
            present = [
                d for d in self.detectors if all((member, d) in self.counts for member in members)
            ]
            selections = [(detector, [detector]) for detector in present]
            if len(present) > 1:
                selections.append((MEAN, present))
            rows.extend(
                self._row(name, label, chosen, renderer, match) for label, chosen in selections
            )
        return rows

    def _row(
        self, name: str, label: str, detectors: list[str], renderer: str, match: str
    ) -> dict[str, Any]:
        members = self.repeats[name]
        control = [] if is_control(name) else self.repeats.get(matched_control(name), [])
        control = [draw for draw in control if all((draw, d) in self.counts for d in detectors)]
        own = self._stack(members, detectors)
        easr = mean_interval(own, overall_attack_success_rate, self.weights, (-math.inf, 1.0))
        asr = mean_interval(own, attack_success_rate, self.weights, (0.0, 1.0))
        er = mean_interval(own, enhancement_rate, self.weights, (0.0, math.inf))
        row: dict[str, Any] = {
            "camouflage": name,
            "renderer": renderer,
            "detector": label,
            "vehicles": self.vehicles[members[0], detectors[0]],
            "easr": easr.estimate,
            "easr_low": easr.low,
            "easr_high": easr.high,
            "net_easr": None,
            "net_easr_low": None,
            "net_easr_high": None,
            "asr": asr.estimate,
            "er": er.estimate,
        }
        if control:
            random = self._stack(control, detectors)
            chance = mean_interval(
                random, overall_attack_success_rate, self.weights, (-math.inf, 1.0)
            )
            net = cluster_interval(
                np.concatenate([own, random]), success_difference(len(own)), self.weights
            )
            net = _no_surer_than_its_parts(net, easr, chance)
            row |= {"net_easr": net.estimate, "net_easr_low": net.low, "net_easr_high": net.high}
        row |= self._set_scores(members, detectors, renderer, match)
        row |= {"clusters": self.tiles[members[0], detectors[0]], "repeats": len(members)}
        row |= _spread(
            overall_attack_success_rate(own.sum(axis=1)).reshape(len(members), -1).mean(axis=1)
        )
        row |= {"asr_low": asr.low, "asr_high": asr.high, "er_low": er.low, "er_high": er.high}
        row["random_easr"] = chance.estimate if control else None
        row |= {"random_draws": len(control), "mcnemar_p": None, "mcnemar_p_holm": None}
        if label != MEAN and not is_control(name):
            row["mcnemar_p"] = _largest_p(own.sum(axis=1))
        return {
            key: None if isinstance(value, float) and math.isnan(value) else value
            for key, value in row.items()
        }

    def _stack(self, camouflages: list[str], detectors: list[str]) -> Int[np.ndarray, "S C 3"]:
        return np.stack(
            [self.counts[camouflage, d] for camouflage in camouflages for d in detectors]
        )

    def _set_scores(
        self, members: list[str], detectors: list[str], renderer: str, match: str
    ) -> dict[str, Any]:
        """AP before and after, APD (PAPER 41) and false alarms; nan where any of the sets was not scored."""

        def mean_of(camouflages: list[str], field: str) -> float:
            found = [
                self.scores.get(Series(c, renderer, d, match))
                for c in camouflages
                for d in detectors
            ]
            return float(
                np.mean([math.nan if score is None else getattr(score, field) for score in found])
            )

        before, after = (
            mean_of([ORIGINAL], "average_precision"),
            mean_of(members, "average_precision"),
        )
        return {
            "ap_original": before,
            "ap_adversarial": after,
            "apd": before - after,
            "match": match,
            "false_alarms_per_km2_original": mean_of([ORIGINAL], "false_alarms_per_km2"),
            "false_alarms_per_km2_adversarial": mean_of(members, "false_alarms_per_km2"),
        }


def _spread(easr: Float[np.ndarray, " repeats"]) -> dict[str, float]:
    """How far the repeats of one row lie apart; nan with one repeat."""
    several = len(easr) > 1
    return {
        "easr_repeat_sd": float(easr.std(ddof=1)) if several else math.nan,
        "easr_repeat_min": float(easr.min()) if several else math.nan,
        "easr_repeat_max": float(easr.max()) if several else math.nan,
    }


def _largest_p(totals: Int[np.ndarray, "repeats 3"]) -> float:
    """The largest of the repeats' McNemar p-values; 1 where they point both ways."""
    balance = totals[:, 1] - totals[:, 2]
    if balance.min() < 0 < balance.max():
        return 1.0
    return max(mcnemar_p(int(lost), int(gained)) for _, lost, gained in totals)


def _no_surer_than_its_parts(net: Interval, easr: Interval, chance: Interval) -> Interval:
    """Widens a net interval where resampling sees no spread in one part, because every tile agrees.

    That part's exact limit then enters by the square-and-add rule for differences of independent rates (MOVER; Zou and
    Donner 2008).
    """
    lower = math.hypot(easr.estimate - easr.low, chance.high - chance.estimate)
    upper = math.hypot(easr.high - easr.estimate, chance.estimate - chance.low)
    unanimous = easr.unanimous or chance.unanimous
    if not unanimous or math.isnan(lower + upper):
        return net
    return Interval(
        net.estimate, min(net.low, net.estimate - lower), max(net.high, net.estimate + upper)
    )


def _unique(values: Any) -> list[str]:
    return list(dict.fromkeys(values))
