"""Accepted, rejected or undecided: a requirement on the share of vehicles that an attack hides.

A requirement is stated as in compliance tests for success ratios (IEC 61123): two shares and the
two risks of a wrong answer. IEC's plans assume independent trials, but vehicles of one tile are
dependent. Here tiles are the trials, each with the share of its found vehicles that is lost. The
evidence against a share is the capital of a gambler who starts with 1 and bets tile by tile that
the mean of the tiles is smaller (or larger), at odds that are fair or worse if it is not. By
Ville's inequality the chance that the capital ever reaches 1/risk is at most the risk, at any
number of looks and any stopping time (Waudby-Smith and Ramdas, "Estimating means of bounded random
variables by betting", 2024). The 1 is divided evenly over fixed bets, so the order of the tiles
does not matter.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int
from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import Risk, check_ranges

Answer = Literal["accepted", "rejected", "undecided"]

# Shares of the largest safe bet: more of them large, which decide soonest (measured on simulated
# tests of ten requirements).
_BETS = 1 - (1 - (np.arange(48) + 0.5) / 48) ** 2
# Where next to nothing can be lost any bet is safe, and it stays finite.
_LEAST_LOSS = 0.05
_MOST_TILES = 10**7
# Part of the producer's risk that the plain paints of a precheck share; the attacks have the rest.
_RISK_OF_PAINTS = 0.2

# The tiles of a precheck are fewer than those of the attacks.
Counted = Mapping[str, tuple[Int[np.ndarray, " _C"], Int[np.ndarray, " _C"]]]
"""Vehicles found before and lost per tile, by attack or by paint."""


@dataclass(frozen=True)
class Requirement:
    """The share of found vehicles that an attack may hide.

    A good detector loses `accept`, a bad one `reject`, which is larger. The risks are the largest
    chances that the producer's good one is rejected, and the consumer's bad one accepted.
    """

    accept: Annotated[float, Meta(ge=0, lt=1)]
    reject: Annotated[float, Meta(gt=0, le=1)]
    producer_risk: Risk = 0.05
    consumer_risk: Risk = 0.05

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.accept >= self.reject:
            raise ConfigurationError(
                "A requirement expects the share lost that is accepted to lie below the share that "
                f"is rejected, got {self.accept:g} and {self.reject:g}; exchange them, or set them "
                "apart: the closer they are, the more vehicles a decision takes."
            )


def requirement_of(
    accept: float | None, reject: float | None, producer_risk: float, consumer_risk: float
) -> Requirement | None:
    """Gives the requirement of two options; None where neither is given."""
    if accept is None and reject is None:
        return None
    if accept is None or reject is None:
        raise ConfigurationError(
            "A requirement expects two shares, --accept and --reject, got only one; give both."
        )
    return Requirement(accept, reject, producer_risk, consumer_risk)


@dataclass(frozen=True)
class Evidence:
    """The evidence of one attack, for a share below `reject` and above `accept`.

    `share` is the mean share lost over tiles, which differs from lost / found if crowded tiles do,
    with its bounds at the producer's and the consumer's risk.
    """

    found: int
    lost: int
    share: float
    at_least: float
    at_most: float
    for_acceptance: float
    for_rejection: float


@dataclass(frozen=True)
class Decision:
    """The answer after all attacks, and the further tiles like these that would decide, if any.

    Accepted if every attack has evidence of 1/consumer_risk for acceptance: an intersection–union
    test, whose risk needs no correction. Rejected if the mean of the attacks' evidence for
    rejection is 1/producer_risk, which keeps the risk for any dependence of the attacks. With
    paints of a precheck, a fifth of the producer's risk is theirs, in equal parts, and the detector
    is also rejected if one of them exceeds `accept` at its part. `paint` is that one: its bounds
    hold for all paints at once, so the choice of the worst adds no risk.
    """

    answer: Answer
    more_tiles: int | None
    attacks: dict[str, Evidence]
    paint: tuple[str, Evidence] | None = None


def decide(
    attacks: Counted,
    requirement: Requirement,
    paints: Counted | None = None,
    *,
    paints_tried: int = 0,
) -> Decision:
    """Decides from vehicles found before and lost per tile, by attack; tiles without any pass.

    Without attacks, as before they were made, `paints` of the precheck may reject: those that may
    matter of all that were tried.
    """
    paints = paints or {}
    every = {**attacks, **paints}
    nothing = not attacks and not paints_tried
    if nothing or not all(int(found.sum()) for found, _ in every.values()):
        raise ConfigurationError(
            "A verdict expects at least one attack and vehicles that are found without it, got "
            "none; look at the detector's precheck first."
        )
    paint = _rejecting_paint(paints, requirement, paints_tried) if paints else None
    decision = _by_attacks(attacks, requirement, 1 - _RISK_OF_PAINTS if paints_tried else 1.0)
    return decision if paint is None else Decision("rejected", 0, decision.attacks, paint)


def _rejecting_paint(
    paints: Counted, requirement: Requirement, tried: int
) -> tuple[str, Evidence] | None:
    """Gives the paint with most evidence for rejection, if that is enough."""
    part = _RISK_OF_PAINTS / tried
    shares = {name: _shares(*counted) for name, counted in paints.items()}
    against = {name: float(evidence_above(s, requirement.accept)) for name, s in shares.items()}
    name = max(against, key=lambda each: (against[each], shares[each].mean()))
    if against[name] < 1 / (part * requirement.producer_risk):
        return None
    return name, _evidence(*paints[name], requirement, part)


def _by_attacks(attacks: Counted, requirement: Requirement, part: float) -> Decision:
    """Decides with a part of the producer's risk."""
    if not attacks:
        return Decision("undecided", None, {})
    shares = {name: _shares(*counted) for name, counted in attacks.items()}
    logarithms = {
        name: (_below(each, requirement.reject), _below(1 - each, 1 - requirement.accept))
        for name, each in shares.items()
    }
    tiles = max(len(each) for each in shares.values())
    said = {name: _evidence(*counted, requirement) for name, counted in attacks.items()}
    limits = (1 / requirement.consumer_risk, 1 / (part * requirement.producer_risk))
    answer = _answer(logarithms, limits, 1.0)
    more = _more_tiles(logarithms, limits, tiles) if answer == "undecided" else 0
    return Decision(answer, more, said)


def _shares(
    found: Int[np.ndarray, " C"], lost: Int[np.ndarray, " C"]
) -> Float[np.ndarray, " _found"]:
    return np.asarray(lost[found > 0] / found[found > 0])


def _evidence(
    found: Int[np.ndarray, " C"],
    lost: Int[np.ndarray, " C"],
    requirement: Requirement,
    part: float = 1.0,
) -> Evidence:
    """Gives the evidence of one attack, with bounds at a part of the risks."""
    shares = _shares(found, lost)
    return Evidence(
        found=int(found.sum()),
        lost=int(lost.sum()),
        share=float(shares.mean()),
        at_least=_bound(shares, part * requirement.producer_risk, below=False),
        at_most=_bound(shares, part * requirement.consumer_risk, below=True),
        for_acceptance=float(evidence_below(shares, requirement.reject)),
        for_rejection=float(evidence_above(shares, requirement.accept)),
    )


def evidence_below(
    shares: Float[np.ndarray, "*runs C"], limit: float
) -> Float[np.ndarray, "*runs"]:
    """Gives the evidence for a mean share below a limit in (0, 1], from independent tiles."""
    return _mean(_below(shares, limit))


def evidence_above(
    shares: Float[np.ndarray, "*runs C"], limit: float
) -> Float[np.ndarray, "*runs"]:
    """Gives the evidence for a mean share above a limit in [0, 1)."""
    return evidence_below(1 - shares, 1 - limit)


def fewest_tiles(reject: float, consumer_risk: float) -> int:
    """Gives the fewest tiles on which a detector can be accepted: one that loses nothing there."""
    one = _below(np.zeros(1), reject)

    def suffice(tiles: int) -> bool:
        return bool(_mean(tiles * one) >= 1 / consumer_risk)

    enough = next(tiles for tiles in (2**power for power in count()) if suffice(tiles))
    return bisect_left(range(enough), True, lo=enough // 2, key=suffice)


def _below(shares: Float[np.ndarray, "*runs C"], limit: float) -> Float[np.ndarray, "*runs bets"]:
    """Gives the logarithm of the capital under each bet, a fixed part of the largest safe one."""
    stakes = _BETS / max(1 - limit, _LEAST_LOSS)
    return np.stack([np.log1p(stake * (limit - shares)).sum(axis=-1) for stake in stakes], axis=-1)


def _mean(logarithms: Float[np.ndarray, "*runs bets"]) -> Float[np.ndarray, "*runs"]:
    """Gives the mean capital, up to e^700."""
    return np.asarray(np.exp(np.minimum(logarithms, 700.0)).mean(axis=-1))


def _answer(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]],
    limits: tuple[float, float],
    times: float,
) -> Answer:
    """Answers by the evidence needed for and against, as if every tile had been seen often."""
    below = [float(_mean(times * each)) for each, _ in logarithms.values()]
    above = [float(_mean(times * each)) for _, each in logarithms.values()]
    if min(below) >= limits[0]:
        return "accepted"
    if sum(above) / len(above) >= limits[1]:
        return "rejected"
    return "undecided"


def _more_tiles(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]],
    limits: tuple[float, float],
    tiles: int,
) -> int | None:
    """Gives the further tiles that decide, by bisection."""
    few, enough = 1.0, 2.0
    while _answer(logarithms, limits, enough) == "undecided":
        few, enough = enough, 2 * enough
        if enough * tiles > _MOST_TILES:
            return None
    while (enough - few) * tiles > 0.5:
        middle = (few + enough) / 2
        if _answer(logarithms, limits, middle) == "undecided":
            few = middle
        else:
            enough = middle
    return max(math.ceil((enough - 1) * tiles), 1)


def _bound(shares: Float[np.ndarray, " C"], risk: float, *, below: bool) -> float:
    """Gives the last limit that the evidence does not exclude, in thousandths."""
    evidence = evidence_below if below else evidence_above
    limits = np.arange(1, 1001) / 1000 if below else np.arange(999, -1, -1) / 1000
    # The evidence grows along the limits.
    left = bisect_left(limits, 1 / risk, key=lambda limit: float(evidence(shares, float(limit))))
    return float(limits[left - 1]) if left else float(shares.mean())
