"""Plans of the standard: known ones, and their risks."""

import numpy as np
import pytest
from scipy import stats

from skyproof.errors import ConfigurationError
from skyproof.results.statistics.acceptance import Requirement, evidence_above, evidence_below
from skyproof.results.statistics.compliance import (
    _chances,
    fixed_plan,
    sequential_plan,
    tiles_to_decide,
)
from skyproof.results.statistics.planning import Assumptions


@pytest.mark.parametrize(
    ("good", "bad", "risk", "trials", "most_lost"),
    [
        (0.05, 0.1, 0.05, 298, 21),
        (0.1, 0.2, 0.05, 135, 19),
        (0.2, 0.3, 0.1, 127, 31),
        (0.0, 0.1, 0.1, 22, 0),
        (0.0, 0.1, 0.05, 29, 0),
    ],
)
def test_the_fixed_plan_is_the_shortest(good, bad, risk, trials, most_lost):
    plan = fixed_plan(Requirement(good, bad, risk, risk))
    assert (plan.trials, plan.most_lost) == (trials, most_lost)
    assert plan.chances(good).accepted >= 1 - risk
    assert plan.chances(bad).accepted <= risk
    # One vehicle fewer does not keep both risks, whatever loss is allowed.
    losses = np.arange(trials)
    keeps = (stats.binom.sf(losses, trials - 1, good) <= risk) & (
        stats.binom.cdf(losses, trials - 1, bad) <= risk
    )
    assert not keeps.any()


def test_risks_may_differ():
    plan = fixed_plan(Requirement(0.1, 0.2, producer_risk=0.2, consumer_risk=0.01))
    assert plan.chances(0.1).accepted >= 0.8
    assert plan.chances(0.2).accepted <= 0.01


@pytest.mark.parametrize(
    ("good", "bad", "risk"), [(0.1, 0.2, 0.05), (0.2, 0.3, 0.1), (0.2, 0.4, 0.05), (0.0, 0.1, 0.1)]
)
def test_the_sequential_plan_keeps_the_risks_with_fewer_vehicles(good, bad, risk):
    requirement = Requirement(good, bad, risk, risk)
    fixed = fixed_plan(requirement)
    plan = sequential_plan(requirement, fixed)
    at_good, at_bad = plan.chances(good), plan.chances(bad)
    assert at_good.accepted >= 1 - risk
    assert at_bad.accepted <= risk
    assert at_bad.trials < fixed.trials
    assert at_good.trials <= fixed.trials
    if good == 0.2 and bad == 0.3:
        # Wald's lines.
        assert (plan.slope, plan.accept_distance) == pytest.approx((0.2477, 4.08), abs=0.01)


def test_the_exact_chances_are_those_of_tests_played_out():
    requirement = Requirement(0.2, 0.4)
    plan = sequential_plan(requirement, fixed_plan(requirement))
    generator = np.random.default_rng(0)
    runs = 4000
    losses = (generator.random((runs, plan.last)) < 0.3).cumsum(axis=1)
    accepted, trials = np.zeros(runs, bool), np.zeros(runs, int)
    for trial in range(1, plan.last + 1):
        going = trials == 0
        count = losses[:, trial - 1]
        yes = going & (count <= plan.accepts_up_to(trial))
        ends = yes | (going & (count >= plan.rejects_from(trial)))
        accepted |= yes
        trials[ends] = trial
    expected = plan.chances(0.3)
    assert (trials > 0).all()
    assert accepted.mean() == pytest.approx(expected.accepted, abs=0.03)
    assert trials.mean() == pytest.approx(expected.trials, rel=0.05)


def test_only_right_answers_count_and_tiles_without_a_found_vehicle_tell_nothing():
    requirement = Requirement(0.1, 0.3, 0.2, 0.2)
    assumptions = Assumptions(0.8, vehicles_per_tile=6.0, design_effect=1.5)
    tiles = tiles_to_decide(requirement, assumptions)
    good, bad = (_chances(requirement, assumptions, tiles, share) for share in (0.1, 0.3))
    assert good[0] >= 0.9
    assert bad[1] >= 0.9
    few = Assumptions(0.8, vehicles_per_tile=1.0, found_before=0.5)
    all_found = Assumptions(0.8, vehicles_per_tile=1.0, found_before=1.0)
    more, fewer = (tiles_to_decide(requirement, one) for one in (few, all_found))
    assert more == pytest.approx(2 * fewer, rel=0.2)


def test_as_many_tiles_as_planned_decide():
    requirement = Requirement(0.1, 0.3)
    assumptions = Assumptions(0.8, vehicles_per_tile=6.0, design_effect=1.5)
    tiles = tiles_to_decide(requirement, assumptions)
    generator = np.random.default_rng(5)
    for rate in (0.1, 0.3):
        found = 1 + generator.poisson(5, (500, tiles))
        inside = generator.beta(rate * 9, (1 - rate) * 9, (500, tiles))
        shares = generator.binomial(found, inside) / found
        decided = (evidence_below(shares, 0.3) >= 20) | (evidence_above(shares, 0.1) >= 20)
        assert decided.mean() >= 0.85
    assert tiles_to_decide(Requirement(0.1, 0.2), assumptions) > 2 * tiles
    with pytest.raises(ConfigurationError, match="farther apart"):
        tiles_to_decide(Requirement(0.2, 0.201), assumptions)
    with pytest.raises(ConfigurationError, match="farther apart"):
        fixed_plan(Requirement(0.2, 0.201))
