"""Advice on the detectors, and the limits of the numbers; never how to hide."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from skyproof import words
from skyproof.camouflage.name import CamouflageName
from skyproof.results.result import MEAN, Result
from skyproof.results.results import Results

_MUCH_BY_CHANCE = 0.1


def advice(rows: Sequence[Result]) -> list[str]:
    """Gives advice on the detectors from the results of one camouflage, the quoted one last."""
    quoted = rows[-1]
    single = [row for row in rows if row.detector != MEAN and not math.isnan(row.easr.estimate)]
    sentences = []
    if len(single) > 1:
        ranked = sorted(single, key=lambda row: row.easr.estimate)
        best = ranked[0]
        worst = ranked[-1]
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
    sentences.append(
        "After hardening, measure the baseline and false alarms again: robustness can cost both."
    )
    sentences.append(
        "Quote net success with its interval, not the gross rate, when comparing detectors or "
        "suppliers."
    )
    return sentences


@dataclass(frozen=True)
class Limits:
    """Facts of a run that limit its numbers.

    Attributes:
        attacked: detectors that the attack was optimised against, if recorded.
        held_out: whether other detectors were scored.
        growing: camouflages with a repeat that was still getting stronger.
        slim: detectors that are reduced versions of the published networks.
    """

    attacked: Sequence[str]
    held_out: bool
    growing: Sequence[str]
    slim: Sequence[str]


def limits(results: Results, every: Sequence[Result]) -> Limits:
    """Gives the facts that limit the numbers of the quoted results."""
    return Limits(
        _attacked(results, every[0].camouflage) if every else [],
        any(name.variant.startswith(("on_", "without_")) for name in results.names),
        _not_converged(results, every),
        [words.detector_name(name) for name, card in results.cards.items() if card.size == "slim"],
    )


def _not_converged(results: Results, every: Sequence[Result]) -> list[str]:
    """Gives the camouflages with a repeat that was still getting stronger."""
    growing = []
    for row in every:
        own = [
            record.convergence
            for name, record in results.records.items()
            if CamouflageName.read(name).pooled == row.camouflage
        ]
        if any(found is not None and not found.converged for found in own):
            growing.append(str(row.camouflage))
    return growing


def _attacked(results: Results, camouflage: CamouflageName) -> list[str]:
    """Gives the detectors that a camouflage was optimised against; empty where not recorded."""
    for name in (str(camouflage), str(camouflage.with_repeat(0))):
        record = results.records.get(name)
        if record is not None and record.attack is not None:
            return [words.detector_name(detector) for detector in record.attack.detectors]
    return []
