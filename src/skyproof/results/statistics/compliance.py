"""Simulated tests of a requirement: the chances of each answer, and the tiles of a decision.

`skyproof.results.statistics.acceptance` decides a real test without assumptions. A simulation
assumes an intra-tile correlation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from skyproof.errors import ConfigurationError
from skyproof.results.statistics.acceptance import Requirement, evidence_above, evidence_below
from skyproof.results.statistics.planning import Assumptions

_MOST_TRIALS = 20_000
_RUNS = 400
_DECIDED = 0.9


@dataclass(frozen=True)
class DecisionChances:
    """The chances of acceptance and rejection by the share lost; the rest is undecided."""

    shares: Float[np.ndarray, " S"]
    accepted: Float[np.ndarray, " S"]
    rejected: Float[np.ndarray, " S"]


def chances_on_tiles(
    requirement: Requirement, assumptions: Assumptions, tiles: int
) -> DecisionChances:
    """Simulates the operating characteristic of a test with one attack.

    Tiles show 1 vehicle or more by a Poisson distribution, and each is found before by chance. A
    tile without a found vehicle is passed over. The rates of tiles have a beta distribution with
    the correlation of the design effect.
    """
    shares = np.linspace(0.0, 1.0, 41)
    chances = [_chances(requirement, assumptions, tiles, float(share)) for share in shares]
    return DecisionChances(shares, *np.array(chances).T)


def tiles_to_decide(requirement: Requirement, assumptions: Assumptions) -> int:
    """Gives the tiles on which nine of ten tests decide rightly, as `chances_on_tiles` simulates.

    The detector loses as much as `accept`, or as `reject`, whichever takes longer.

    Raises:
        ConfigurationError: more than 20,000 are needed.
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
