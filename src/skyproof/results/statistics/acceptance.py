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
    rejection is 1/producer_risk, which keeps the risk for any dependence of the attacks.
    """

    answer: Answer
    more_tiles: int | None
    attacks: dict[str, Evidence]


def decide(
    attacks: Mapping[str, tuple[Int[np.ndarray, " C"], Int[np.ndarray, " C"]]],
    requirement: Requirement,
) -> Decision:
    """Decides from vehicles found before and lost per tile, by attack; tiles without any pass."""
    if not attacks or not all(int(found.sum()) for found, _ in attacks.values()):
        raise ConfigurationError(
            "A verdict expects at least one attack and vehicles that are found without it, got "
            "none; look at the detector's precheck first."
        )
    shares = {name: lost[found > 0] / found[found > 0] for name, (found, lost) in attacks.items()}
    logarithms = {
        name: (_below(each, requirement.reject), _below(1 - each, 1 - requirement.accept))
        for name, each in shares.items()
    }
    tiles = max(len(each) for each in shares.values())
    said = {
        name: Evidence(
            found=int(found.sum()),
            lost=int(lost.sum()),
            share=float(shares[name].mean()),
            at_least=_bound(shares[name], requirement.producer_risk, below=False),
            at_most=_bound(shares[name], requirement.consumer_risk, below=True),
            for_acceptance=float(_mean(logarithms[name][0])),
            for_rejection=float(_mean(logarithms[name][1])),
        )
        for name, (found, lost) in attacks.items()
    }
    answer = _answer(logarithms, requirement, 1.0)
    more = _more_tiles(logarithms, requirement, tiles) if answer == "undecided" else 0
    return Decision(answer, more, said)


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
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]], requirement: Requirement, times: float
) -> Answer:
    """Answers as if every tile had been seen this many times."""
    below = [float(_mean(times * each)) for each, _ in logarithms.values()]
    above = [float(_mean(times * each)) for _, each in logarithms.values()]
    if min(below) >= 1 / requirement.consumer_risk:
        return "accepted"
    if sum(above) / len(above) >= 1 / requirement.producer_risk:
        return "rejected"
    return "undecided"


def _more_tiles(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]], requirement: Requirement, tiles: int
) -> int | None:
    """Gives the further tiles that decide, by bisection."""
    few, enough = 1.0, 2.0
    while _answer(logarithms, requirement, enough) == "undecided":
        few, enough = enough, 2 * enough
        if enough * tiles > _MOST_TILES:
            return None
    while (enough - few) * tiles > 0.5:
        middle = (few + enough) / 2
        if _answer(logarithms, requirement, middle) == "undecided":
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
