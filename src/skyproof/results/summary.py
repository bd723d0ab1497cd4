"""From counts to the table of results: rows per camouflage, renderer, detector and criterion."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.name import CamouflageName
from skyproof.results.pairs.outcomes import MATCHES
from skyproof.results.pairs.sets import ORIGINAL, SetScore
from skyproof.results.pairs.tiles import Series, TileCounts
from skyproof.results.rows import MEAN, Row
from skyproof.results.statistics.differences import difference_interval
from skyproof.results.statistics.intervals import holm, mcnemar_p, mean_interval, resample
from skyproof.results.statistics.rates import (
    attack_success_rate,
    enhancement_rate,
    overall_attack_success_rate,
)

__all__ = ["summarise"]


def summarise(
    tiles: TileCounts, sets: Sequence[SetScore], *, generator: np.random.Generator
) -> list[Row]:
    """Makes the rows of `results.json`.

    Repeats of one camouflage ("T-U-0", "T-U-1": seeds of an attack, draws of a control) share one
    row: the mean over repeats, and over detectors in row "mean" (unweighted; undefined where one
    detector found no vehicle before). Net EASR is a row's EASR minus its random control's. All of
    it is on the same resampled tiles, so the intervals cover which scenes were drawn, for these
    very repeats; how the repeats spread is said beside them by `easr_repeat_sd` (sample standard
    deviation), `easr_repeat_min` and `easr_repeat_max`.

    `mcnemar_p` is the largest over the repeats, and 1 where some lose vehicles on balance and
    others gain them, so that what it claims holds for every repeat. Holm's correction runs over
    the detectors' rows of one match criterion, controls excluded.

    Args:
        tiles: counts of every camouflage, renderer, detector and match.
        sets: average precision and false alarms of every set, "original" included; what is missing
            is undefined.
        generator: of the bootstrap.
    """
    # A table per match criterion and renderer, from the counts and set scores of both.
    rows: list[Row] = []
    scores = {Series(s.camouflage, s.renderer, s.detector, s.match): s for s in sets}
    for match in MATCHES:
        for renderer in _unique(key.renderer for key in tiles.series if key.match == match):
            here = {
                key: counts
                for key, counts in tiles.series.items()
                if key.renderer == renderer and key.match == match
            }
            rows.extend(_Table(here, scores, generator).rows(renderer, match))

    # Holm's correction needs all p-values of a criterion, so it comes last.
    for match in MATCHES:
        tested = [
            index
            for index, row in enumerate(rows)
            if row.match == match and row.mcnemar_p is not None
        ]
        corrected = holm([rows[index].mcnemar_p or 0.0 for index in tested])
        for index, p in zip(tested, corrected, strict=True):
            rows[index] = replace(rows[index], mcnemar_p_holm=p)
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
        self.repeats: dict[CamouflageName, list[str]] = defaultdict(list)
        for camouflage in _unique(key.camouflage for key in series):
            self.repeats[CamouflageName.read(camouflage).pooled].append(camouflage)
        self.scores = scores
        self.weights = resample(int(shown.sum()), generator=generator)

    def rows(self, renderer: str, match: str) -> list[Row]:
        rows: list[Row] = []
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
        self, name: CamouflageName, label: str, detectors: list[str], renderer: str, match: str
    ) -> Row:
        members = self.repeats[name]
        first = (members[0], detectors[0])

        # Rates of the camouflage itself, and how far its repeats lie apart.
        counts = self._stack(members, detectors)
        of_repeats = overall_attack_success_rate(counts.sum(axis=1)).reshape(len(members), -1)
        spread = of_repeats.mean(axis=1)
        several = len(spread) > 1

        # What its random control does on the same tiles.
        control = [] if name.random else self.repeats.get(name.control, [])
        control = [draw for draw in control if all((draw, d) in self.counts for d in detectors)]
        random = self._stack(control, detectors) if control else None

        # Average precision, and what else the row needs.
        ap_original = self._mean([ORIGINAL], detectors, renderer, match, "average_precision")
        ap_adversarial = self._mean(members, detectors, renderer, match, "average_precision")
        alarms = "false_alarms_per_km2"
        weights = self.weights
        tested = label != MEAN and not name.random
        return Row(
            camouflage=name,
            renderer=renderer,
            detector=label,
            match=match,
            vehicles=self.vehicles[first],
            clusters=self.tiles[first],
            repeats=len(members),
            easr=mean_interval(counts, overall_attack_success_rate, weights, (-math.inf, 1.0)),
            asr=mean_interval(counts, attack_success_rate, weights, (0.0, 1.0)),
            er=mean_interval(counts, enhancement_rate, weights, (0.0, math.inf)),
            net_easr=None if random is None else difference_interval([counts], [random], weights),
            random_easr=None if random is None else _mean_easr(random),
            random_draws=len(control),
            easr_repeat_sd=float(spread.std(ddof=1)) if several else math.nan,
            easr_repeat_min=float(spread.min()) if several else math.nan,
            easr_repeat_max=float(spread.max()) if several else math.nan,
            ap_original=ap_original,
            ap_adversarial=ap_adversarial,
            apd=ap_original - ap_adversarial,
            false_alarms_per_km2_original=self._mean(
                [ORIGINAL], detectors, renderer, match, alarms
            ),
            false_alarms_per_km2_adversarial=self._mean(
                members, detectors, renderer, match, alarms
            ),
            mcnemar_p=_largest_p(counts.sum(axis=1)) if tested else None,
        )

    def _stack(self, camouflages: list[str], detectors: list[str]) -> Int[np.ndarray, "S C 3"]:
        return np.stack(
            [self.counts[camouflage, d] for camouflage in camouflages for d in detectors]
        )

    def _mean(
        self, camouflages: list[str], detectors: list[str], renderer: str, match: str, field: str
    ) -> float:
        """Gives the mean of a set score; nan where any of the sets was not scored."""
        known = [
            self.scores.get(Series(camouflage, renderer, detector, match))
            for camouflage in camouflages
            for detector in detectors
        ]
        values = [math.nan if score is None else getattr(score, field) for score in known]
        return float(np.mean(values))


def _mean_easr(counts: Int[np.ndarray, "S C 3"]) -> float:
    rates: Float[np.ndarray, " S"] = overall_attack_success_rate(counts.sum(axis=1))
    return float(rates.mean())


def _largest_p(totals: Int[np.ndarray, "repeats 3"]) -> float:
    """Gives the largest of the repeats' McNemar p-values; 1 where they point both ways."""
    balance = totals[:, 1] - totals[:, 2]
    if balance.min() < 0 < balance.max():
        return 1.0
    return max(mcnemar_p(int(lost), int(gained)) for _, lost, gained in totals)


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))
