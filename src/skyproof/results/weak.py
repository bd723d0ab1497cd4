"""Weak attacks: those that another camouflage within their constraints beats."""

from skyproof.camouflage.name import CamouflageName
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import Results
from skyproof.words import percent


def weak_attacks(results: Results) -> list[str]:
    """Says which attacks hide less than another camouflage that meets their constraints.

    That may be an attack under more constraints, a chosen control or a random draw. The attack
    could have found it, so it was optimised too little or chance favours the other. Variants of an
    attack are left out. Rates are those of the mean over detectors, by the main rule.
    """
    sentences = []
    for row in results.quoted:
        name = row.camouflage
        if name.variant:
            continue
        rates = {
            str(other.camouflage): other.easr.estimate
            for other in results.rows
            if (other.renderer, other.detector) == (row.renderer, row.detector)
            and other.match == MAIN_MATCH
            and other.camouflage != name
            and _meets(other.camouflage, name)
        }
        if row.strongest is not None and _meets(row.strongest.control, name):
            rates[str(row.strongest.control)] = row.strongest.easr
        best = max(rates, key=lambda other: rates[other], default=None)
        if best is not None and rates[best] > row.easr.estimate:
            sentences.append(
                f"{name} hides {percent(row.easr.estimate)} and {best}, which it could have found, "
                f"{percent(rates[best])}"
            )
    return sentences


def _meets(other: CamouflageName, name: CamouflageName) -> bool:
    known = "other" not in (other.kind, name.kind)
    return known and (not other.variant or other.choice is not None) and other.meets(name)
