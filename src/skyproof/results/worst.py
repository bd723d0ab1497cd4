"""The worst case: the vehicles that at least one of several attacks hides.

An attacker picks the camouflage that works on the vehicle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from skyproof.camouflage.name import CamouflageName
from skyproof.results.results import RENDERER, Results
from skyproof.results.rows_file import interval_columns, nulls_for_undefined
from skyproof.results.statistics.contrasts import Group, difference_interval, mean_interval
from skyproof.results.statistics.intervals import UNDEFINED, Interval
from skyproof.results.statistics.rates import attack_success_rate
from skyproof.results.statistics.repeats import DRAWS, Repeat


@dataclass(frozen=True)
class WorstCase:
    """The share that all attacks together hide from one detector.

    Attributes:
        detector, renderer: names.
        attacks: the optimised camouflages.
        hidden: share of the found vehicles that at least one of them hides.
        strongest, alone: the attack that alone hides most, and its share.
        random: the share for as many random draws, one of each attack's control, as the mean over
            all such sets; None if a control was not drawn.
        net: `hidden` minus `random`.
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
        """Gives flat JSON values, as `results.json` holds them; undefined ones are None."""
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
    """Gives the worst case of each detector; none for fewer than two attacks.

    Only the first repeat of each attack counts.

    Raises:
        StoredFileError: a table of outcomes is damaged.
    """
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
    lost = _Lost.of(results, renderer)
    sets = _sets_of_draws([name.control for name in attacks], set(scored))
    return [
        found
        for detector in results.detectors
        if (found := _worst_case(results, lost, detector, renderer, attacks, sets)) is not None
    ]


def _sets_of_draws(controls: Sequence[CamouflageName], scored: Set[str]) -> list[list[str]]:
    """Gives all sets of one different draw for each attack."""
    sets: list[list[str]] = []
    while True:
        used: Counter[CamouflageName] = Counter()
        draws = []
        for control in controls:
            sharing = controls.count(control)
            draws.append(str(control.with_repeat(len(sets) * sharing + used[control])))
            used[control] += 1
        if not scored >= set(draws):
            return sets
        sets.append(draws)


def _worst_case(
    results: Results,
    lost: _Lost,
    detector: str,
    renderer: str,
    attacks: dict[CamouflageName, str],
    sets: Sequence[Sequence[str]],
) -> WorstCase | None:
    def group(sets: Iterable[Iterable[str]], repeats: Sequence[Sequence[Repeat]]) -> Group:
        counts = [lost.counts(detector, names) for names in sets]
        return Group(np.stack(counts), results.sample, repeats)

    own = group([attacks.values()], [])
    if not own.counts[..., :2].sum():
        return None
    alone = {name: group([[text]], []) for name, text in attacks.items()}
    each = {
        name: float(attack_success_rate(one.counts.sum(axis=1))[0]) for name, one in alone.items()
    }
    strongest = max(each, key=lambda name: each[name])
    random = net = None
    if sets:
        # A set of draws, one of each control, is one repeat of several.
        repeats = [[Repeat("worst case", str(number), DRAWS)] for number in range(len(sets))]
        control = group(sets, repeats)
        random = float(attack_success_rate(control.counts.sum(axis=1)).mean())
        net = difference_interval([own], [control])
    hidden = mean_interval(own, rate=attack_success_rate, limits=(0.0, 1.0))
    return WorstCase(
        detector, renderer, list(attacks), hidden, strongest, each[strongest], random, net
    )


@dataclass(frozen=True)
class _Lost:
    """Hidden vehicles.

    Attributes:
        cells: number of each tile and vehicle of the fleet in the sample.
        before: per detector, cell of each found vehicle by scene and placement.
        lost: per detector and camouflage, the hidden ones.
    """

    cells: dict[tuple[str, str], int]
    before: dict[str, dict[tuple[str, int], int]]
    lost: dict[tuple[str, str], set[tuple[str, int]]]

    @classmethod
    def of(cls, results: Results, renderer: str) -> _Lost:
        cells = {cell: number for number, cell in enumerate(results.counts.cells)}
        before: dict[str, dict[tuple[str, int], int]] = {}
        lost: dict[tuple[str, str], set[tuple[str, int]]] = {}
        for one in results.outcomes(None, renderer):
            if one.detected_original:
                place = (one.scene, one.placement)
                before.setdefault(one.detector, {})[place] = cells[one.background, one.vehicle]
                if not one.detected_adversarial:
                    lost.setdefault((one.detector, one.camouflage), set()).add(place)
        return cls(cells, before, lost)

    def counts(self, detector: str, camouflages: Iterable[str]) -> Int[np.ndarray, "N 3"]:
        """Counts (both, lost, gained) per cell; lost to any of them, and none is gained."""
        hidden: set[tuple[str, int]] = set()
        for camouflage in camouflages:
            hidden |= self.lost.get((detector, camouflage), set())
        counts = np.zeros((len(self.cells), 3), dtype=np.int64)
        for place, cell in self.before.get(detector, {}).items():
            counts[cell, int(place in hidden)] += 1
        return counts
