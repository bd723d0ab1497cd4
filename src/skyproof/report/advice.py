"""Advice on the detectors, how to harden them, and limits of the numbers; never how to hide."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skyproof import words
from skyproof.camouflage.name import CamouflageName
from skyproof.layout import Layout
from skyproof.results.conditions import Bin, Panel
from skyproof.results.result import MEAN, Result
from skyproof.results.results import RENDERER, Results
from skyproof.results.stored import AttackRecord
from skyproof.results.weak import weak_attacks

_MUCH_BY_CHANCE = 0.1
_STRONGEST = 2


def advice(rows: Sequence[Result]) -> list[str]:
    """Returns advice on the detectors from the results of one camouflage, the quoted one last."""
    quoted = rows[-1]
    single = [row for row in rows if row.detector != MEAN and not math.isnan(row.easr.estimate)]
    sentences = []
    if len(single) > 1:
        best, *_, worst = sorted(single, key=lambda row: row.easr.estimate)
        if best.easr.high < worst.easr.low:
            sentences.append(
                f"{words.detector_name(best.detector)} withstands {quoted.camouflage} better "
                f"than {words.detector_name(worst.detector)} "
                f"({words.percent(best.easr.estimate)} against "
                f"{words.percent(worst.easr.estimate)} hidden): harden the weaker one first."
            )
        # Neither holds where an interval is undefined.
        elif best.easr.high >= worst.easr.low:
            sentences.append(
                "The detectors’ intervals overlap, so this result gives no reason to prefer one."
            )
    random = quoted.random
    if random is not None and random.easr > _MUCH_BY_CHANCE:
        sentences.append(
            f"Random patterns already hide {words.percent(random.easr)}, so the detectors depend "
            "on ordinary vehicle colours. Train with more varied vehicle textures first."
        )
    strongest = quoted.strongest
    if strongest is not None and strongest.easr > _MUCH_BY_CHANCE:
        sentences.append(
            f"The control {strongest.control} hides {words.percent(strongest.easr)} without any "
            "optimisation. This weakness is the cheapest to close: add such vehicles to training."
        )
    surest = strongest or random
    if surest is not None and surest.net.low > 0:
        sentences.append(
            "The optimised pattern hides more than its controls, so variety alone may not "
            "suffice. Add vehicles with this camouflage and their labels to training, then measure "
            "again with a newly optimised pattern. A detector that is hardened against a known "
            "pattern is not thereby hardened against the next."
        )
    return [
        *sentences,
        "After hardening, measure the baseline and false alarms again: robustness can cost both.",
        "Quote net success with its interval, not the gross rate, when comparing detectors or "
        "suppliers.",
    ]


def limits(results: Results, every: Sequence[Result]) -> dict[str, Any]:
    """Returns the facts that limit the numbers of the quoted results."""
    slim = [name for name, card in results.cards.items() if card.size == "slim"]
    return {
        # Detectors that the attack was optimised against, if recorded.
        "attacked": _attacked(results, every[0].camouflage) if every else [],
        # Whether other detectors were scored.
        "held_out": any(name.variant.startswith(("on_", "without_")) for name in results.names),
        "by_paper": _recorded(results, every, lambda record: record.method == "paper"),
        # Camouflages with a repeat that was still getting stronger.
        "growing": _recorded(
            results, every, lambda r: r.convergence is not None and not r.convergence.converged
        ),
        "weak": weak_attacks(results),
        # Reduced versions of the published networks.
        "slim": [words.detector_name(name) for name in slim],
    }


def _recorded(
    results: Results, every: Sequence[Result], holds: Callable[[AttackRecord], bool]
) -> list[str]:
    """Lists the quoted camouflages that have a repeat whose record `holds` accepts."""
    found = {
        CamouflageName.read(name).pooled for name, each in results.records.items() if holds(each)
    }
    return [str(row.camouflage) for row in every if row.camouflage in found]


def _attacked(results: Results, camouflage: CamouflageName) -> list[str]:
    for name in (str(camouflage), str(camouflage.with_repeat(0))):
        record = results.records.get(name)
        if record is not None and record.attack is not None:
            return [words.detector_name(detector) for detector in record.attack.detectors]
    return []


@dataclass(frozen=True)
class Hardening:
    """The strongest attacks by their folders, and what `skyproof harden` does about them.

    The command trains a `trainable` detector further, and renders images for any other. `alone`
    says that the run is an assessment of one detector, which the command needs.
    """

    attacks: Mapping[str, CamouflageName]
    trainable: bool
    alone: bool


def hardening(results: Results, every: Sequence[Result]) -> Hardening | None:
    """Names the strongest attacks of different kinds.

    None where no attack surely hides anything, or the run folder lacks what hardening needs.
    """
    layout = Layout(results.folder)
    kinds: dict[Any, tuple[str, CamouflageName]] = {}
    for row in sorted(every, key=lambda row: -row.easr.estimate):
        name = row.camouflage
        folders = {str(name), str(name.with_repeat(0))} & results.records.keys()
        if folders and row.easr.low > 0 and row.renderer == RENDERER and not name.kept_copy:
            kinds.setdefault((name.kind, name.constraints), (min(folders), name))
    needed = (layout.backgrounds / "index.json", layout.fleets / "attack")
    if not kinds or not results.test_scenes or not all(place.exists() for place in needed):
        return None
    cards = results.cards
    trainable = all(name in cards and cards[name].trainable for name in results.detectors)
    alone = bool(results.config.suite) and len(results.detectors) == 1
    return Hardening(dict([*kinds.values()][:_STRONGEST]), trainable, alone)


def readings(panels: Sequence[Panel]) -> list[str]:
    """Says in one sentence per panel whether the intervals of its extreme bins are apart.

    Panels of which fewer than two bins have an interval are left out.
    """
    sentences = []
    for panel in panels:
        known = [bar for bar in panel.bins if bar.rate.low == bar.rate.low]
        if len(known) < 2:
            continue
        most = max(known, key=lambda bar: bar.rate.estimate)
        least = min(known, key=lambda bar: bar.rate.estimate)
        reading = "no clear difference; the intervals overlap."
        if most.rate.low > least.rate.high:
            reading = f"most hidden at {_told(most)}, least at {_told(least)}; "
            reading += "the intervals do not overlap."
        sentences.append(f"{panel.title}: {reading}")
    return sentences


def _told(bar: Bin) -> str:
    return f"{bar.label} ({words.percent(bar.rate.estimate)})".replace("\n", " ")
