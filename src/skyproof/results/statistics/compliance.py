"""Test plans for a success ratio, as in IEC 61123: how many vehicles, and how many may be lost.

Trials are vehicles, independent and with one chance of being lost; a design effect says how many
more vehicles a test needs whose tiles show several each. What a test has shown is decided without
such an assumption (`skyproof.results.statistics.acceptance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from skyproof.errors import ConfigurationError
from skyproof.results.statistics.acceptance import Requirement, evidence_above, evidence_below
from skyproof.results.statistics.planning import Assumptions

_MOST_TRIALS = 20_000
_RUNS = 400
_DECIDED = 0.9


@dataclass(frozen=True)
class Chances:
    """What a plan does with a detector that loses a given share.

    Attributes:
        accepted: chance that it is accepted; else it is rejected.
        trials: how many vehicles are looked at, on average.
    """

    accepted: float
    trials: float


@dataclass(frozen=True)
class FixedPlan:
    """So many vehicles are looked at; accepted if at most so many are lost."""

    trials: int
    most_lost: int

    def chances(self, share: float) -> Chances:
        """Says what happens to a detector that loses this share."""
        return Chances(
            float(stats.binom.cdf(self.most_lost, self.trials, share)), float(self.trials)
        )


@dataclass(frozen=True)
class SequentialPlan:
    """Vehicles are looked at one by one, until their losses cross one of two lines (Wald's test).

    Accepted at trial n if at most slope·n − accept_distance are lost, rejected if at least
    slope·n + reject_distance. At the last trial the nearer line decides.

    Attributes:
        slope: losses a vehicle, between the two shares of the requirement.
        accept_distance, reject_distance: of the lines from slope·n.
        last: trial at which it ends.
    """

    slope: float
    accept_distance: float
    reject_distance: float
    last: int

    def accepts_up_to(self, trial: int) -> int:
        """Gives the most losses that accept at this trial; −1 where it is too early."""
        if trial == self.last:
            middle = self.slope * trial + (self.reject_distance - self.accept_distance) / 2
            return math.floor(middle)
        return max(math.floor(self.slope * trial - self.accept_distance), -1)

    def rejects_from(self, trial: int) -> int:
        """Gives the fewest losses that reject at this trial; more than it has where too early."""
        if trial == self.last:
            return self.accepts_up_to(trial) + 1
        return math.ceil(self.slope * trial + self.reject_distance)

    def chances(self, share: float) -> Chances:
        """Says what happens to a detector that loses this share; exactly, trial by trial."""
        going = np.zeros(self.last + 2)
        going[0] = 1.0
        accepted = trials = 0.0
        for trial in range(1, self.last + 1):
            trials += float(going.sum())
            going[1:] = going[1:] * (1 - share) + going[:-1] * share
            going[0] *= 1 - share
            accept, reject = self.accepts_up_to(trial), self.rejects_from(trial)
            accepted += float(going[: accept + 1].sum())
            going[: accept + 1] = 0.0
            going[reject:] = 0.0
        return Chances(accepted, trials)


def fixed_plan(requirement: Requirement) -> FixedPlan:
    """Finds the fewest vehicles whose losses keep both risks.

    Raises:
        ConfigurationError: more than 20,000 would be needed.
    """
    most_lost = 0
    for trials in range(1, _MOST_TRIALS + 1):
        # The most losses that still keep the consumer's risk.
        while (
            stats.binom.cdf(most_lost + 1, trials, requirement.reject) <= requirement.consumer_risk
        ):
            most_lost += 1
        if stats.binom.cdf(most_lost, trials, requirement.reject) > requirement.consumer_risk:
            continue
        if stats.binom.sf(most_lost, trials, requirement.accept) <= requirement.producer_risk:
            return FixedPlan(trials, most_lost)
    raise ConfigurationError(
        f"No test of at most {_MOST_TRIALS:,} vehicles tells a share of "
        f"{100 * requirement.accept:g} % from {100 * requirement.reject:g} % with these risks; "
        "set the two shares farther apart."
    )


def sequential_plan(requirement: Requirement, fixed: FixedPlan) -> SequentialPlan:
    """Finds a sequential plan that keeps both risks though it ends.

    Of Wald's lines, or else of lines with the distances that keep the risks without end, it takes
    the shortest plan in steps of 5 % from the fixed plan on.

    Args:
        requirement: what is asked; for the lines a share of 0 is taken as 1e-6, one of 1 as
            1 − 1e-6.
        fixed: the fixed plan of this requirement.
    """
    good = max(requirement.accept, 1e-6)
    bad = min(requirement.reject, 1 - 1e-6)
    # A lost vehicle speaks for the bad share by this much, a kept one for the good share.
    lost, kept = math.log(bad / good), math.log((1 - good) / (1 - bad))
    producer, consumer = requirement.producer_risk, requirement.consumer_risk
    for right in ((1 - producer, 1 - consumer), (1.0, 1.0)):
        accept = math.log(right[0] / consumer) / (lost + kept)
        reject = math.log(right[1] / producer) / (lost + kept)
        last = fixed.trials
        while last <= 4 * fixed.trials + 100:
            plan = SequentialPlan(kept / (lost + kept), accept, reject, last)
            if (
                1 - plan.chances(requirement.accept).accepted <= producer
                and plan.chances(requirement.reject).accepted <= consumer
            ):
                return plan
            last = math.ceil(last * 1.05)
    return plan


@dataclass(frozen=True)
class DecisionChances:
    """What a test of tiles does with detectors that lose more and more.

    Attributes:
        shares: lost to the one attack that decides, `[S]`.
        accepted, rejected: chances, `[S]`; the rest is undecided.
    """

    shares: Float[np.ndarray, " S"]
    accepted: Float[np.ndarray, " S"]
    rejected: Float[np.ndarray, " S"]


def chances_on_tiles(
    requirement: Requirement, assumptions: Assumptions, tiles: int
) -> DecisionChances:
    """Gives the operating characteristic of a test on so many tiles, by simulation.

    Tiles show 1 vehicle or more by a Poisson distribution, of which each is found before by chance;
    a tile without one says nothing. What tiles have in common is a beta distribution of the design
    effect's correlation.
    """
    shares = np.linspace(0.0, 1.0, 41)
    chances = [_chances(requirement, assumptions, tiles, float(share)) for share in shares]
    return DecisionChances(shares, *np.array(chances).T)


def tiles_to_decide(requirement: Requirement, assumptions: Assumptions) -> int:
    """Says on how many tiles nine of ten tests decide rightly, by the simulation of
    `chances_on_tiles`.

    The detector loses as much as `accept`, or as `reject`, whichever takes longer, and one attack
    decides.

    Raises:
        ConfigurationError: more than 20,000 would be needed.
    """

    def enough(tiles: int) -> bool:
        accepted, _ = _chances(requirement, assumptions, tiles, requirement.accept)
        if accepted < _DECIDED:
            return False
        _, rejected = _chances(requirement, assumptions, tiles, requirement.reject)
        return rejected >= _DECIDED

    many = 4
    while not enough(many):
        many *= 2
        if many > _MOST_TRIALS:
            raise ConfigurationError(
                f"On no {_MOST_TRIALS:,} tiles do nine of ten tests decide between "
                f"{100 * requirement.accept:g} % and {100 * requirement.reject:g} %; set the two "
                "shares farther apart."
            )
    few = many // 2
    while many - few > max(1, many // 50):
        middle = (few + many) // 2
        if enough(middle):
            many = middle
        else:
            few = middle
    return many


def _chances(
    requirement: Requirement, assumptions: Assumptions, tiles: int, share: float
) -> tuple[float, float]:
    """Gives the chances of acceptance and of rejection of a detector that loses this share."""
    generator = np.random.default_rng(0)
    found_per_tile = assumptions.vehicles_per_tile * assumptions.found_before
    correlation = (assumptions.design_effect - 1) / max(found_per_tile - 1, 1e-9)
    certainty = 1 / min(max(correlation, 1e-6), 1 - 1e-6) - 1
    # A beta distribution has no rate of exactly 0 or 1.
    inside = min(max(share, 1e-9), 1 - 1e-9)
    shape = (_RUNS, tiles)
    shown = 1 + generator.poisson(max(assumptions.vehicles_per_tile - 1, 0.0), shape)
    found = generator.binomial(shown, assumptions.found_before)
    rate = generator.beta(inside * certainty, (1 - inside) * certainty, shape)
    shares = generator.binomial(found, rate) / np.maximum(found, 1)
    # A share at the limit is no evidence either way.
    below, above = (
        np.where(found > 0, shares, limit) for limit in (requirement.reject, requirement.accept)
    )
    accepted = evidence_below(below, requirement.reject) >= 1 / requirement.consumer_risk
    rejected = evidence_above(above, requirement.accept) >= 1 / requirement.producer_risk
    return float(accepted.mean()), float((rejected & ~accepted).mean())
