"""The worst case: the vehicles that at least one of several attacks hides."""

import itertools
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from skyproof.camouflage.name import CamouflageName
from skyproof.results.outcomes import Outcome
from skyproof.results.results import RENDERER, Results
from skyproof.results.rows_file import interval_columns, nulls_for_undefined
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import UNDEFINED, Interval, attack_success_rate
from skyproof.results.statistics.repeats import DRAWS, Repeat


@dataclass(frozen=True)
class WorstCase:
    """The share of the found vehicles that all attacks together hide from one detector.

    `alone` is the share of the strongest attack. `random` is that of a set with one draw of each
    attack's control, as the mean over all such sets; None if a control was not drawn.
    """

    detector: str
    renderer: str
    attacks: Sequence[CamouflageName]
    hidden: Interval
    strongest: CamouflageName
    alone: float
    random: float | None
    net: Interval | None

    def json(self) -> dict[str, Any]:
        """Returns flat JSON values, as `results.json` holds them; undefined ones are None."""
        values = {
            "detector": self.detector,
            "renderer": self.renderer,
            "attacks": [str(name) for name in self.attacks],
            **interval_columns("hidden", self.hidden),
            "strongest": str(self.strongest),
            "strongest_hidden": self.alone,
            "random_hidden": self.random,
            **interval_columns("net", self.net or UNDEFINED),
        }
        return nulls_for_undefined(values)


def worst_cases(results: Results, renderer: str = RENDERER) -> list[WorstCase]:
    """Returns the worst case per detector, by the first repeat of each of two or more attacks."""
    scored = list(
        dict.fromkeys(key.camouflage for key in results.counts.series if key.renderer == renderer)
    )
    attacks: dict[CamouflageName, str] = {}
    for text in scored:
        name = CamouflageName.read(text)
        if not name.random and not name.variant:
            attacks.setdefault(name.pooled, text)
    if len(attacks) < 2:
        return []
    sets = _sets_of_draws([name.control for name in attacks], set(scored))
    found: dict[str, list[Outcome]] = {}
    for one in results.outcomes(None, renderer):
        if one.detected_original:
            found.setdefault(one.detector, []).append(one)
    return [
        _worst_case(results, found[detector], attacks, sets)
        for detector in results.detectors
        if detector in found
    ]


def _sets_of_draws(controls: Sequence[CamouflageName], scored: Set[str]) -> list[list[str]]:
    """Returns all sets of one draw per attack, in which no draw occurs twice."""
    sets: list[list[str]] = []
    repeats = {control: itertools.count() for control in controls}
    while True:
        draws = [str(control.with_repeat(next(repeats[control]))) for control in controls]
        if not scored >= set(draws):
            return sets
        sets.append(draws)


def _worst_case(
    results: Results,
    found: Sequence[Outcome],
    attacks: dict[CamouflageName, str],
    sets: Sequence[Sequence[str]],
) -> WorstCase:
    row_of = {cell: row for row, cell in enumerate(results.counts.cells)}
    cells = {(one.scene, one.placement): row_of[one.background, one.vehicle] for one in found}
    lost: dict[str, set[tuple[str, int]]] = {}
    for one in found:
        if not one.detected_adversarial:
            lost.setdefault(one.camouflage, set()).add((one.scene, one.placement))

    def group(sets: Sequence[Iterable[str]], repeats: Sequence[Sequence[Repeat]] = ()) -> Group:
        """Counts per set (both, lost to any camouflage of the set, gained: always 0)."""
        counts = np.zeros((len(sets), len(row_of), 3), dtype=np.int64)
        for names, own in zip(sets, counts, strict=True):
            hidden = set().union(*(lost.get(name, ()) for name in names))
            for place, cell in cells.items():
                own[cell, int(place in hidden)] += 1
        return Group(counts, results.sample, repeats)

    own = group([attacks.values()])
    alone = attack_success_rate(group([[text] for text in attacks.values()]).counts.sum(axis=1))
    strongest = int(alone.argmax())
    random = net = None
    if sets:
        # Each set of draws, one per control, counts as one repeat.
        repeats = [[Repeat("worst case", str(number), DRAWS)] for number in range(len(sets))]
        control = group(sets, repeats)
        random = float(attack_success_rate(control.counts.sum(axis=1)).mean())
        net = difference_interval([own], [control])
    return WorstCase(
        found[0].detector,
        found[0].renderer,
        list(attacks),
        mean_interval(own, rate=attack_success_rate, limits=(0.0, 1.0)),
        list(attacks)[strongest],
        float(alone[strongest]),
        random,
        net,
    )
