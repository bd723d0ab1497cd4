"""From counts to the table of results: rows per camouflage, renderer, detector and criterion."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from skyproof.camouflage.controls import controls
from skyproof.camouflage.name import CamouflageName
from skyproof.results.pairs.outcomes import MATCHES, ORIGINAL
from skyproof.results.pairs.tiles import Cell, Series, TileCounts
from skyproof.results.repeats import repeat_of
from skyproof.results.result import MEAN, Contrast, Result
from skyproof.results.score_folder import SetScore
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.hypotheses import control_p, holm, unchanged_p
from skyproof.results.statistics.rates import (
    attack_success_rate,
    enhancement_rate,
    overall_attack_success_rate,
)
from skyproof.results.statistics.sample import Sample


def summarise(
    tiles: TileCounts, sets: Sequence[SetScore], *, generator: np.random.Generator
) -> list[Result]:
    """Makes the rows of `results.json`.

    Repeats of one camouflage ("T-U-0", "T-U-1": seeds of an attack, draws of a control) share one
    row: the mean over repeats, and over detectors in row "mean" (unweighted; undefined where one
    detector found no vehicle before). Net EASR is a row's EASR minus its random control's. All of
    it is on the same tiles and vehicles. The intervals cover which of these were drawn and, where
    there are several, which seeds and draws; how these lie apart is said beside them by
    `easr_repeat_sd` (sample standard deviation), `easr_repeat_min` and `easr_repeat_max`.

    Two things are tested: that learning hides more than every draw of a control (`Contrast`), and
    that there is a change against no camouflage (`no_camouflage_p`). Both are the largest p of the
    repeats, and 1 where these point both ways, so that what is claimed holds for each. Holm's
    correction runs over the camouflages of one detector and match criterion; who claims something
    of every detector takes the largest of theirs, which needs no further correction.

    Args:
        tiles: counts of every camouflage, renderer, detector and match.
        sets: average precision and false alarms of every set, "original" included; what is missing
            is undefined.
        generator: of the bootstrap.
    """
    # A table per match criterion and renderer, from the counts and set scores of both.
    rows: list[Result] = []
    scores = {Series(s.camouflage, s.renderer, s.detector, s.match): s for s in sets}
    for match in MATCHES:
        for renderer in _unique(key.renderer for key in tiles.series if key.match == match):
            here = {
                key: counts
                for key, counts in tiles.series.items()
                if key.renderer == renderer and key.match == match
            }
            rows.extend(_Table(tiles.cells, here, scores, generator).rows(renderer, match))

    # Holm's correction needs all p-values of a family, so it comes last.
    families: dict[tuple[str, str], list[int]] = defaultdict(list)
    for index, row in enumerate(rows):
        families[row.match, row.detector].append(index)
    for family in families.values():
        for field in ("random", "strongest", "drawn_shape"):
            found = {index: getattr(rows[index], field) for index in family}
            tested = {index: each for index, each in found.items() if each and each.p is not None}
            corrected = holm([each.p for each in tested.values()])
            for (index, each), p in zip(tested.items(), corrected, strict=True):
                change: dict[str, Any] = {field: replace(each, p_holm=p)}
                rows[index] = replace(rows[index], **change)
        tested_rows = [index for index in family if rows[index].no_camouflage_p is not None]
        corrected = holm([rows[index].no_camouflage_p or 0.0 for index in tested_rows])
        for index, p in zip(tested_rows, corrected, strict=True):
            rows[index] = replace(rows[index], no_camouflage_p_holm=p)
    return rows


class _Table:
    """The counts of one renderer and one match criterion, and their rows."""

    def __init__(
        self,
        cells: Sequence[Cell],
        series: Mapping[Series, Int[np.ndarray, "N 4"]],
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
        names = np.array([tile for tile, _ in cells], dtype=object)
        self.tiles = {
            (key.camouflage, key.detector): len(set(names[counts[:, 0] > 0]))
            for key, counts in series.items()
        }
        self.detectors = _unique(key.detector for key in series)
        self.repeats: dict[CamouflageName, list[str]] = defaultdict(list)
        for camouflage in _unique(key.camouflage for key in series):
            self.repeats[CamouflageName.read(camouflage).pooled].append(camouflage)
        self.scores = scores
        known = [cell for cell, seen in zip(cells, shown, strict=True) if seen]
        self.sample = Sample.draw(known, generator=generator)
        self._groups: dict[tuple[tuple[str, ...], tuple[str, ...]], Group] = {}

    def rows(self, renderer: str, match: str) -> list[Result]:
        rows: list[Result] = []
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
    ) -> Result:
        members = self.repeats[name]
        first = (members[0], detectors[0])

        # Rates of the camouflage itself, and how far its repeats lie apart.
        group = self.group(members, detectors)
        totals = group.counts.sum(axis=1)
        of_repeats = overall_attack_success_rate(totals).reshape(len(members), -1)
        spread = of_repeats.mean(axis=1)
        several = len(spread) > 1

        # What its controls do on the same tiles.
        beside = _Beside(self, members, detectors, group)
        shape = controls(name).random_shape

        # Average precision, and what else the row needs.
        ap_original = self._mean([ORIGINAL], detectors, renderer, match, "average_precision")
        ap_adversarial = self._mean(members, detectors, renderer, match, "average_precision")
        alarms = "false_alarms_per_km2"
        sample = self.sample
        untested = label == MEAN or name.random
        return Result(
            camouflage=name,
            renderer=renderer,
            detector=label,
            match=match,
            vehicles=self.vehicles[first],
            clusters=self.tiles[first],
            repeats=len(members),
            easr=mean_interval(group, sample),
            asr=mean_interval(group, sample, rate=attack_success_rate, limits=(0.0, 1.0)),
            er=mean_interval(group, sample, rate=enhancement_rate, limits=(0.0, math.inf)),
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
            random=None if name.random else beside.contrast(name.control),
            strongest=None if name.random else beside.strongest(controls(name).chosen),
            drawn_shape=None if shape is None else beside.contrast(shape),
            no_camouflage_p=None if untested else unchanged_p(totals),
        )

    def drawn(self, control: CamouflageName, detectors: list[str]) -> list[str]:
        """Lists the repeats of a control that all of these detectors have judged."""
        repeats = self.repeats.get(control, [])
        return [draw for draw in repeats if all((draw, d) in self.counts for d in detectors)]

    def group(self, camouflages: list[str], detectors: list[str]) -> Group:
        """Puts series together, once for all rows in which they stand."""
        wanted = (tuple(camouflages), tuple(detectors))
        if wanted not in self._groups:
            series = [(camouflage, d) for camouflage in camouflages for d in detectors]
            repeats = [[repeat_of(camouflage)] for camouflage, _ in series]
            self._groups[wanted] = Group(np.stack([self.counts[each] for each in series]), repeats)
        return self._groups[wanted]

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


@dataclass(frozen=True)
class _Beside:
    """One row's camouflage, to be set beside its controls."""

    table: _Table
    members: list[str]
    detectors: list[str]
    group: Group

    def contrast(self, control: CamouflageName) -> Contrast | None:
        """Sets it beside all draws of one control; None where none was scored."""
        drawn = self.table.drawn(control, self.detectors)
        if not drawn:
            return None
        group = self.table.group(drawn, self.detectors)
        net = difference_interval([self.group], [group], self.table.sample)
        return Contrast(control, group.rate, len(drawn), net, self._p(drawn))

    def strongest(self, controls: Sequence[CamouflageName]) -> Contrast | None:
        """Sets it beside the strongest of some controls, sure only of what holds against all.

        An undefined rate stays undefined.
        """
        found = [each for each in map(self.contrast, controls) if each is not None]
        if not found:
            return None
        best = max(found, key=lambda each: each.easr)
        low = float(np.min([each.net.low for each in found]))
        every = [draw for each in found for draw in self.table.drawn(each.control, self.detectors)]
        return replace(best, net=replace(best.net, low=low), p=self._p(every))

    def _p(self, drawn: list[str]) -> float | None:
        """Tests learnt against drawn; None where a detector found no vehicle before."""
        found = self.group.counts[: len(self.detectors), :, :2].sum(axis=(1, 2))
        if not all(found):
            return None
        learnt, control = (
            np.stack([self._hidden(camouflage, found) for camouflage in camouflages])
            for camouflages in (self.members, drawn)
        )
        return control_p(learnt, control)

    def _hidden(self, camouflage: str, found: Int[np.ndarray, " D"]) -> Float[np.ndarray, " C"]:
        """Gives lost minus gained per tile, over what each detector found before."""
        counts = [self.table.counts[camouflage, d] for d in self.detectors]
        tiles = self.table.sample.by_tile(np.stack(counts))
        hidden: Float[np.ndarray, " C"] = ((tiles[..., 1] - tiles[..., 2]) / found[:, None]).sum(
            axis=0
        )
        return hidden


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))
