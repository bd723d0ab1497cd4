"""Accepted, rejected or undecided: a requirement on the share of vehicles that an attack hides.

A requirement is stated as in compliance tests for success ratios (IEC 61123): two shares and the
two risks of a wrong answer. IEC's plans assume independent trials, but vehicles of one tile are
dependent. Here tiles are the trials. The evidence for a share below a limit is the capital of a
gambler who starts with 1 and wins or loses limit × found − lost vehicles on each tile, times a
stake. The mean gain is at most 0 unless a smaller share of the vehicles is lost. By Ville's
inequality the chance that the capital ever reaches 1/risk is at most the risk, at any number of
looks and any stopping time (Waudby-Smith and Ramdas, "Estimating means of bounded random variables
by betting", 2024). The 1 is divided evenly over fixed stakes, so the order of the tiles does not
matter.

No tile may cost all capital, so a stake is limited by the vehicles that the tile's scenes could
show, not by those they do show: smaller stakes on crowded scenes would make it a bet on the mean of
the tiles. The number of scenes on a tile is drawn without a look at its ground, so it tells nothing
of the share that is lost there.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Num
from msgspec import Meta

from skyproof.errors import ConfigurationError
from skyproof.ranges import Risk, check_ranges
from skyproof.scenes.settings import SceneSettings

Answer = Literal["accepted", "rejected", "undecided"]

# Stakes as shares of the largest that is safe on the tile with the fewest scenes. Most are large,
# because these decide soonest (measured on simulated tests of ten requirements).
_STAKES = 1 - (1 - (np.arange(48) + 0.5) / 48) ** 2
# Largest share of the capital that a tile may cost, because losing all would end the game.
_MOST_COST = 0.98
# Where almost nothing can be lost, any stake is safe; this bound keeps it finite.
_LEAST_LOSS = 0.05
_MOST_TILES = 10**7
# Part of the producer's risk that the plain paints of a precheck share; the attacks have the rest.
_RISK_OF_PAINTS = 0.2

_SCENE = SceneSettings()
MOST_IN_SCENE = _SCENE.vehicles_maximum
"""Largest number of vehicles in a scene of the usual settings."""
USUAL_IN_SCENE = (_SCENE.vehicles_minimum + MOST_IN_SCENE) / 2
"""Mean number of vehicles in a scene of the usual settings."""


@dataclass(frozen=True)
class Tiles:
    """Vehicles found before and lost per tile, of `scenes` scenes with at most `most` vehicles.

    Neither the number of scenes nor `most` may depend on the ground or on the detector.
    """

    scenes: Num[np.ndarray, "*runs C"]
    found: Num[np.ndarray, "*runs C"]
    lost: Num[np.ndarray, "*runs C"]
    most: int = MOST_IN_SCENE

    @property
    def share(self) -> float:
        """The share of the found vehicles that is lost."""
        return float(self.lost.sum() / self.found.sum())


Counted = Mapping[str, Tiles]
"""The tiles by attack or by paint; those of a precheck are fewer."""


@dataclass(frozen=True)
class Requirement:
    """The share of found vehicles that an attack may hide.

    A good detector loses at most `accept`, a bad one at least `reject`, which is larger. The risks
    are the largest chances that a good one is rejected (producer), a bad one accepted (consumer).
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
    """Returns the requirement of two options; None where neither is given."""
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

    `share` is lost / found, with its bounds at the producer's and the consumer's risk.
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
    """Decides from vehicles found before and lost per tile, by attack.

    Even before any attack, paints of the precheck may reject the detector: `paints` holds those of
    the `paints_tried` that could.
    """
    paints = paints or {}
    every = {**attacks, **paints}
    nothing = not attacks and not paints_tried
    if nothing or not all(tiles.found.sum() for tiles in every.values()):
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
    """Returns the paint with the most evidence for rejection, if it is enough to reject."""
    part = _RISK_OF_PAINTS / tried
    accept = requirement.accept
    against = {name: float(evidence_above(tiles, accept)) for name, tiles in paints.items()}
    name = max(against, key=lambda each: (against[each], paints[each].share))
    if against[name] < 1 / (part * requirement.producer_risk):
        return None
    return name, _evidence(paints[name], requirement, part)


def _by_attacks(attacks: Counted, requirement: Requirement, part: float) -> Decision:
    """Decides with a part of the producer's risk."""
    if not attacks:
        return Decision("undecided", None, {})
    logarithms = {
        name: (_below(each, requirement.reject), _below(_kept(each), 1 - requirement.accept))
        for name, each in attacks.items()
    }
    tiles = max(len(each.found) for each in attacks.values())
    evidence = {name: _evidence(each, requirement) for name, each in attacks.items()}
    limits = (1 / requirement.consumer_risk, 1 / (part * requirement.producer_risk))
    answer = _answer(logarithms, limits, 1.0)
    more = _more_tiles(logarithms, limits, tiles) if answer == "undecided" else 0
    return Decision(answer, more, evidence)


def _evidence(tiles: Tiles, requirement: Requirement, part: float = 1.0) -> Evidence:
    """Returns the evidence of one attack, with bounds at a part of the risks."""
    return Evidence(
        found=int(tiles.found.sum()),
        lost=int(tiles.lost.sum()),
        share=tiles.share,
        at_least=_bound(tiles, part * requirement.producer_risk, below=False),
        at_most=_bound(tiles, part * requirement.consumer_risk, below=True),
        for_acceptance=float(evidence_below(tiles, requirement.reject)),
        for_rejection=float(evidence_above(tiles, requirement.accept)),
    )


def evidence_below(tiles: Tiles, limit: float) -> Float[np.ndarray, "*runs"]:
    """Returns the evidence for a share below a limit in (0, 1], from independent tiles."""
    return _mean(_below(tiles, limit))


def evidence_above(tiles: Tiles, limit: float) -> Float[np.ndarray, "*runs"]:
    """Returns the evidence for a share above a limit in [0, 1)."""
    return evidence_below(_kept(tiles), 1 - limit)


def _kept(tiles: Tiles) -> Tiles:
    """Counts vehicles that are found before and after as lost."""
    return replace(tiles, lost=tiles.found - tiles.lost)


def fewest_tiles(reject: float, consumer_risk: float) -> int:
    """Returns the fewest tiles of usual scenes that accept a detector which loses nothing."""
    one = _below(Tiles(np.ones(1), np.full(1, USUAL_IN_SCENE), np.zeros(1)), reject)
    return fewest(lambda tiles: bool(_mean(tiles * one) >= 1 / consumer_risk), 1)


def fewest(enough: Callable[[int], bool], start: int, precision: int | None = None) -> int:
    """Returns the fewest tiles from `start` on that are enough, to a part of 1/`precision`."""
    many = start
    while not enough(many):
        many *= 2
    few = many // 2
    while many - few > max(1, many // precision if precision else 1):
        middle = (few + many) // 2
        if enough(middle):
            many = middle
        else:
            few = middle
    return many


def _below(tiles: Tiles, limit: float) -> Float[np.ndarray, "*runs bets"]:
    """Returns the logarithm of the capital under each stake.

    A stake is the same for every vehicle, except on tiles with so many scenes that they might cost
    all capital.
    """
    room = tiles.scenes * tiles.most
    won = (limit * tiles.found - tiles.lost) / (max(1 - limit, _LEAST_LOSS) * room)
    larger = room / room.min(axis=-1, keepdims=True)
    capitals = [
        np.log1p(np.minimum(stake * larger, _MOST_COST) * won).sum(axis=-1) for stake in _STAKES
    ]
    return np.stack(capitals, axis=-1)


def _mean(logarithms: Float[np.ndarray, "*runs bets"]) -> Float[np.ndarray, "*runs"]:
    """Returns the mean capital, up to e^700."""
    return np.asarray(np.exp(np.minimum(logarithms, 700.0)).mean(axis=-1))


def _answer(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]],
    limits: tuple[float, float],
    times: float,
) -> Answer:
    """Answers by the evidence for and against, as if every tile had been seen so many `times`."""
    below = [float(_mean(times * each)) for each, _ in logarithms.values()]
    above = [float(_mean(times * each)) for _, each in logarithms.values()]
    if min(below) >= limits[0]:
        return "accepted"
    if sum(above) / len(above) >= limits[1]:
        return "rejected"
    return "undecided"


def _more_tiles(
    logarithms: Mapping[str, tuple[np.ndarray, np.ndarray]], limits: tuple[float, float], tiles: int
) -> int | None:
    """Returns the number of further tiles that would decide, by bisection."""
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


def _bound(tiles: Tiles, risk: float, *, below: bool) -> float:
    """Returns the last limit that the evidence does not exclude, in thousandths, or the share."""
    evidence = evidence_below if below else evidence_above
    limits = np.arange(1, 1001) / 1000 if below else np.arange(999, -1, -1) / 1000
    # The evidence grows along the limits.
    left = bisect_left(limits, 1 / risk, key=lambda limit: float(evidence(tiles, float(limit))))
    bound = float(limits[left - 1]) if left else tiles.share
    return max(bound, tiles.share) if below else min(bound, tiles.share)
