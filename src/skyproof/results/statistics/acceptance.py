"""Accepted, rejected or undecided: a requirement on the share of vehicles that an attack hides.

What is required is told as in compliance tests for success ratios (IEC 61123): two shares and the
two risks of a wrong answer. IEC's plans take trials as independent, which vehicles of one tile are
not. Here tiles are the trials, each with the share of its found vehicles that is lost, whatever
these have in common. The evidence against a share is what a gambler has made of 1, who bets tile by
tile that the mean of the tiles is smaller (or larger), at odds that are fair or worse if it is not.
By Ville's inequality the chance that such a gambler ever holds 1/risk is at most the risk, however
often one looks and whenever one stops (Waudby-Smith and Ramdas, "Estimating means of bounded random
variables by betting", 2024). The gambler here divides the 1 evenly over fixed bets, so that the
order of the tiles does not matter.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
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
_LEAST_LOSS = 0.05
"""Where next to nothing can be lost any bet is safe, and it stays finite."""
_MOST_TILES = 10**7


@dataclass(frozen=True)
class Requirement:
    """What is asked of a detector: the share of found vehicles that every attack may hide.

    Attributes:
        accept: share lost at which a detector is good (the producer's risk point).
        reject: share lost at which it is bad (the consumer's risk point); above `accept`.
        producer_risk: chance at most that a detector as good as `accept` is rejected.
        consumer_risk: chance at most that a detector as bad as `reject` is accepted.
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
    """Gives what two options ask; None where neither is given.

    Raises:
        ConfigurationError: only one of the shares is given, or they make no requirement.
    """
    if accept is None and reject is None:
        return None
    if accept is None or reject is None:
        raise ConfigurationError(
            "A requirement expects two shares, --accept and --reject, got only one; give both."
        )
    return Requirement(accept, reject, producer_risk, consumer_risk)


@dataclass(frozen=True)
class Evidence:
    """What one attack says of a detector.

    Attributes:
        found: vehicles found before.
        lost: how many of them the attack hides.
        share: mean over tiles of the share lost; it differs from lost / found where crowded tiles
            fare otherwise.
        at_least, at_most: which shares lost these tiles leave open, with the producer's risk that
            it is less, and the consumer's risk that it is more.
        for_acceptance: evidence that the share lost is below `reject`.
        for_rejection: evidence that it is above `accept`.
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
    """The answer before all attacks.

    Attributes:
        answer: accepted, where every attack has evidence of 1/consumer_risk for acceptance: an
            intersection–union test, whose risk needs no correction. Rejected, where the mean of
            the attacks' evidence for rejection is 1/producer_risk, which holds the risk whatever
            attacks have in common.
        more_tiles: how many more tiles like these would decide; 0 where it is decided, None where
            none would.
        attacks: what each says, by name.
    """

    answer: Answer
    more_tiles: int | None
    attacks: dict[str, Evidence]


def decide(
    attacks: Mapping[str, tuple[Int[np.ndarray, " C"], Int[np.ndarray, " C"]]],
    requirement: Requirement,
) -> Decision:
    """Decides on a detector.

    Args:
        attacks: by name, per tile the vehicles found before, and those of them lost. Tiles on
            which none was found say nothing.
        requirement: what is asked.

    Raises:
        ConfigurationError: no attack, or no vehicle found.
    """
    if not attacks or not all(int(found.sum()) for found, _ in attacks.values()):
        raise ConfigurationError(
            "A verdict expects at least one attack and vehicles that are found without it, got "
            "none; look at the detector's check first."
        )
    shares = {name: lost[found > 0] / found[found > 0] for name, (found, lost) in attacks.items()}
    logarithms = {
        name: (_below(each, requirement.reject), _above(each, requirement.accept))
        for name, each in shares.items()
    }
    answer = _answer(logarithms, requirement, 1.0)
    more: int | None = 0
    if answer == "undecided":
        tiles = max(len(each) for each in shares.values())
        more = _more_tiles(logarithms, requirement, tiles)
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
    return Decision(answer, more, said)


def evidence_below(
    shares: Float[np.ndarray, "*runs C"], limit: float
) -> Float[np.ndarray, "*runs"]:
    """Gives the evidence for a mean below a limit; if it is not, ever 1/risk with a chance ≤ risk.

    Args:
        shares: lost per tile, in [0, 1]; tiles are alike and independent.
        limit: in (0, 1].
    """
    return _mean(_below(shares, limit))


def evidence_above(
    shares: Float[np.ndarray, "*runs C"], limit: float
) -> Float[np.ndarray, "*runs"]:
    """Gives the evidence for a mean above a limit in [0, 1); else as `evidence_below`."""
    return _mean(_above(shares, limit))


def fewest_tiles(reject: float, consumer_risk: float) -> int:
    """Gives the fewest tiles on which a detector can be accepted: one that loses nothing there."""
    tiles = 1
    while evidence_below(np.zeros(tiles), reject) < 1 / consumer_risk:
        tiles += 1
    return tiles


def _below(shares: Float[np.ndarray, "*runs C"], limit: float) -> Float[np.ndarray, "*runs bets"]:
    """Gives the logarithm of what 1 became under each bet, of a fixed part of what is safe."""
    stakes = _BETS / max(1 - limit, _LEAST_LOSS)
    return np.stack([np.log1p(stake * (limit - shares)).sum(axis=-1) for stake in stakes], axis=-1)


def _above(shares: Float[np.ndarray, "*runs C"], limit: float) -> Float[np.ndarray, "*runs bets"]:
    return _below(1 - shares, 1 - limit)


def _mean(logarithms: Float[np.ndarray, "*runs bets"]) -> Float[np.ndarray, "*runs"]:
    """Gives the evidence: the mean of the bets, up to e^700."""
    return np.asarray(np.exp(np.minimum(logarithms, 700.0)).mean(axis=-1))


def _answer(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]], requirement: Requirement, times: float
) -> Answer:
    """Answers as if every tile had been seen so many times."""
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
    """Halves what lies between the tiles that there are and as many as would decide."""
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
    """Gives the last limit, in steps of a thousandth, that the evidence does not exclude."""
    evidence = evidence_below if below else evidence_above
    limits = np.arange(1, 1001) / 1000 if below else np.arange(999, -1, -1) / 1000
    left = [float(limit) for limit in limits if evidence(shares, float(limit)) < 1 / risk]
    return left[-1] if left else float(shares.mean())
