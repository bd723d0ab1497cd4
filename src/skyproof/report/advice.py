"""What the numbers suggest for the detectors, and what limits them; never how to hide."""

from __future__ import annotations

import math
from collections.abc import Sequence

from skyproof import words
from skyproof.camouflage.name import CamouflageName
from skyproof.results.results import Results
from skyproof.results.rows import MEAN, Headline

_FEW_TILES = 20
_MUCH_BY_CHANCE = 0.1


def advice(headline: Headline) -> list[str]:
    """Says what the first camouflage's numbers suggest for the detectors."""
    single = [
        row
        for row in headline.by_detector
        if row.detector != MEAN and not math.isnan(row.easr.estimate)
    ]
    sentences = []
    if len(single) > 1:
        ranked = sorted(single, key=lambda row: row.easr.estimate)
        best = ranked[0]
        worst = ranked[-1]
        if best.easr.high < worst.easr.low:
            sentences.append(
                f"{words.detector_name(best.detector)} withstands {headline.camouflage} better "
                f"than {words.detector_name(worst.detector)} "
                f"({words.percent(best.easr.estimate)} against "
                f"{words.percent(worst.easr.estimate)} hidden): harden the weaker one first."
            )
        # Neither holds where an interval is undefined.
        elif best.easr.high >= worst.easr.low:
            sentences.append(
                "The detectors' intervals overlap: this result gives no ground to prefer one of "
                "them."
            )
    random = headline.row.random
    if random is not None and random.easr > _MUCH_BY_CHANCE:
        sentences.append(
            f"Random patterns already hide {words.percent(random.easr)}: the detectors depend on "
            "ordinary vehicle colours. Train with more varied vehicle textures before anything "
            "else."
        )
    unlearnt = headline.row.unlearnt
    if unlearnt is not None and unlearnt.easr > _MUCH_BY_CHANCE:
        sentences.append(
            f"{unlearnt.control}, which nobody learnt, hides {words.percent(unlearnt.easr)}: that "
            "is the cheapest weakness to close, with such vehicles in training."
        )
    surest = unlearnt or random
    if surest is not None and surest.net.low > 0:
        sentences.append(
            "The learnt pattern does more than its controls, so variety alone may not suffice: put "
            "such camouflaged vehicles, with their true labels, into training, then measure again "
            "with a newly optimised pattern. A detector hardened against a known pattern is not "
            "thereby hardened against the next."
        )
    sentences.append(
        "After hardening, check accuracy on clean images and false alarms as well; robustness can "
        "cost both."
    )
    sentences.append(
        "Quote net success with its interval, not the gross rate, when comparing detectors or "
        "suppliers."
    )
    return sentences


def limits(
    results: Results,
    every: Sequence[Sequence[Headline]],
    *,
    asked: bool = False,
    more: bool = False,
) -> list[str]:
    """Says what the numbers do not cover.

    Args:
        results: of the run.
        every: headlines by camouflage.
        asked: whether attacks by answers were made beside those by gradients.
        more: whether the page has further sections, which tell of other detectors.
    """
    sentences = []
    if results.sources == ["procedural"]:
        sentences.append(
            "Ground and vehicles are synthetic. How far these rates carry over to real cameras is "
            "not measured here."
        )
    elif results.sources:
        sentences.append(
            "The ground is real, the vehicles are rendered. Success on painted vehicles is not "
            "measured here."
        )
    if len(results.renderers) > 1:
        sentences.append(
            "Blender Cycles draws the same synthetic vehicle shapes, in another light and with "
            "other materials. It shows whether a camouflage survives a change of renderer, not "
            "whether it survives in reality."
        )
    if every:
        tiles = every[0][0].row.clusters
        few = " That is few: read the intervals as rough." if tiles < _FEW_TILES else ""
        sentences.append(f"The intervals rest on {tiles} background tiles.{few}")
        sentences.append(
            "The intervals cover which tiles and vehicles were drawn and, where there are several, "
            "which seeds of the attack and draws of the random control. They do not cover another "
            "training of the detectors."
        )
        attacked = _attacked(results, every[0][0])
        if attacked:
            others = any(name.variant.startswith(("on_", "without_")) for name in results.names)
            sentences.append(
                f"The pattern was optimised with full knowledge of {', '.join(attacked)}: a worst "
                "case for them. Detectors that the pattern was not optimised against may lose "
                "fewer vehicles; "
                + ("the tables show some." if others or more else "that is not measured here.")
            )
        if attacked and not asked:
            sentences.append(
                "Attacks by answers alone were not made beside these, so nothing tells whether the "
                "detectors’ gradients mislead attacks, as those of some defences do."
            )
        growing = _not_converged(results, every)
        if growing:
            sentences.append(
                f"{', '.join(growing)}: the second half of the attack’s steps still hid over 2 "
                "points more on its own scenes, so more steps may hide more than is said here."
            )
    for size in ("slim", "wide"):
        names = [
            words.detector_name(name)
            for name, card in results.detectors.items()
            if card.size == size
        ]
        if names:
            sentences.append(
                f"{', '.join(names)}: reduced ({size}) versions, not the published networks."
            )
    if every:
        sentences.append(
            "The test against random draws treats tiles as independent, McNemar's against no "
            "camouflage even vehicles; trust the interval more."
        )
    return sentences


def _not_converged(results: Results, every: Sequence[Sequence[Headline]]) -> list[str]:
    """Gives the headlines' camouflages of which a repeat was still getting stronger."""
    growing = []
    for headline, *_ in every:
        own = [
            record.convergence
            for name, record in results.records.items()
            if CamouflageName.read(name).pooled == headline.camouflage
        ]
        if any(found is not None and not found.converged for found in own):
            growing.append(str(headline.camouflage))
    return growing


def _attacked(results: Results, headline: Headline) -> list[str]:
    """Gives the detectors that a camouflage was learnt against; empty where it is not recorded."""
    for name in (str(headline.camouflage), str(headline.camouflage.with_repeat(0))):
        record = results.records.get(name)
        if record is not None and record.attack is not None:
            return [words.detector_name(detector) for detector in record.attack.detectors]
    return []
