"""Advice on the detectors, and the limits of the numbers; never how to hide."""

import math
from collections.abc import Sequence

from skyproof import words
from skyproof.camouflage.name import CamouflageName
from skyproof.results.result import MEAN, Result
from skyproof.results.results import Results

_FEW_TILES = 20
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


def limits(
    results: Results,
    every: Sequence[Result],
    *,
    queried: bool = False,
    more: bool = False,
) -> list[str]:
    """Names the limits of the numbers.

    Args:
        results: of the run.
        every: result to quote of each camouflage.
        queried: whether query attacks were run beside those by gradients.
        more: whether the page has further sections, which tell of other detectors.
    """
    sentences = []
    if results.sources == ["procedural"]:
        sentences.append(
            "Ground and vehicles are synthetic. This report does not measure how far the rates "
            "carry over to real cameras."
        )
    elif results.sources:
        sentences.append(
            "The ground is real and the vehicles are rendered. This report does not measure "
            "success on painted vehicles."
        )
    if len(results.renderers) > 1:
        sentences.append(
            "Blender Cycles draws the same synthetic vehicle shapes in another light and with "
            "other materials. It shows whether a camouflage survives a change of renderer, not "
            "whether it survives in reality."
        )
    if every:
        tiles = every[0].clusters
        few = " That is few: read the intervals as rough." if tiles < _FEW_TILES else ""
        sentences.append(f"The intervals rest on {tiles} background tiles.{few}")
        sentences.append(
            "The intervals cover the draw of tiles and vehicles and, with several of them, of "
            "attack seeds and random controls. They do not cover another training of the "
            "detectors."
        )
        attacked = _attacked(results, every[0].camouflage)
        if attacked:
            others = any(name.variant.startswith(("on_", "without_")) for name in results.names)
            sentences.append(
                f"The attack had full knowledge of {', '.join(attacked)}, a worst case for them. "
                "Held-out detectors may lose fewer vehicles"
                + (" (see the tables)." if others or more else "; none was scored here.")
            )
        if attacked and not queried:
            sentences.append(
                "No query attack was run beside the gradient attacks, so this report cannot tell "
                "whether the detectors mask their gradients, as some defences do."
            )
        growing = _not_converged(results, every)
        if growing:
            sentences.append(
                f"{', '.join(growing)}: the second half of the steps still added over 2 points on "
                "the attack’s own scenes, so more steps may hide more."
            )
    names = [
        words.detector_name(name) for name, card in results.cards.items() if card.size == "slim"
    ]
    if names:
        sentences.append(f"{', '.join(names)}: reduced (slim) versions of the published networks.")
    if every:
        sentences.append(
            "The test against random draws treats tiles as independent, and McNemar’s test even "
            "treats vehicles so. Trust the interval more."
        )
    return sentences


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
