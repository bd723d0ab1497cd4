"""Decisions keep their risks, on tiles whose vehicles fare alike, however often one looks."""

import numpy as np
import pytest

from skyproof.errors import ConfigurationError
from skyproof.results.statistics.acceptance import (
    Requirement,
    decide,
    evidence_above,
    evidence_below,
    fewest_tiles,
)

RUNS = 300


def simulate(rate, tiles, *, correlation=0.1, runs=RUNS, seed=0):
    """Vehicles found and lost per tile; 2 to 11 of them fare alike."""
    generator = np.random.default_rng(seed)
    found = generator.integers(2, 12, (runs, tiles))
    certainty = 1 / correlation - 1
    inside = generator.beta(rate * certainty, (1 - rate) * certainty, (runs, tiles))
    return found, generator.binomial(found, inside)


def ever(evidence, shares, limit, risk):
    """How often the evidence reaches 1/risk at any of some looks at the growing test."""
    looks = range(5, shares.shape[1] + 1, 5)
    reached = [evidence(shares[:, :tiles], limit) >= 1 / risk for tiles in looks]
    return np.any(reached, axis=0).mean()


@pytest.mark.parametrize("correlation", [0.02, 0.1, 0.4])
@pytest.mark.parametrize(("good", "bad", "risk"), [(0.2, 0.3, 0.05), (0.05, 0.1, 0.1)])
def test_both_risks_hold_though_one_looks_again_and_again(good, bad, risk, correlation):
    for rate, evidence, limit in ((bad, evidence_below, bad), (good, evidence_above, good)):
        found, lost = simulate(rate, 150, correlation=correlation)
        # 300 runs: three standard errors are 3.8 and 5.2 points.
        allowed = risk + 3 * np.sqrt(risk * (1 - risk) / RUNS)
        assert ever(evidence, lost / found, limit, risk) <= allowed


def test_independent_trials_would_not_hold_them():
    """Why tiles are the trials: a binomial test of the same vehicles errs far too often."""
    from scipy import stats

    found, lost = simulate(0.3, 60, correlation=0.4)
    wrong = stats.binom.cdf(lost.sum(1), found.sum(1), 0.3) <= 0.05
    assert wrong.mean() > 0.1
    assert (evidence_below(lost / found, 0.3) >= 20).mean() <= 0.05


@pytest.mark.parametrize(("rate", "answer"), [(0.1, "accepted"), (0.45, "rejected")])
def test_clear_cases_are_decided(rate, answer):
    found, lost = simulate(rate, 40, runs=1)
    decision = decide({"T-U": (found[0], lost[0])}, Requirement(0.2, 0.3))
    assert (decision.answer, decision.more_tiles) == (answer, 0)
    said = decision.attacks["T-U"]
    assert said.at_least < said.share < said.at_most
    assert (said.found, said.lost) == (found.sum(), lost.sum())
    if answer == "accepted":
        assert said.at_most < 0.3
        assert said.for_acceptance >= 20
    else:
        assert said.at_least > 0.2
        assert said.for_rejection >= 20


def test_the_worst_attack_decides():
    found, lost = simulate(0.05, 40, runs=1)
    _, worse = simulate(0.6, 40, runs=1)
    weak, strong = (found[0], lost[0]), (found[0], np.minimum(worse[0], found[0]))
    requirement = Requirement(0.2, 0.3)
    assert decide({"weak": weak}, requirement).answer == "accepted"
    assert decide({"weak": weak, "strong": strong}, requirement).answer == "rejected"


def test_one_of_many_attacks_rejects_only_with_as_much_more_evidence():
    """Some attack among twenty passes the line by chance; their mean does not."""
    shares = []
    for seed in range(20):
        found, lost = simulate(0.2, 40, runs=RUNS, seed=seed)
        shares.append((found, lost))
    rejected = any_alone = 0
    for run in range(100):
        attacks = {str(i): (found[run], lost[run]) for i, (found, lost) in enumerate(shares)}
        requirement = Requirement(0.2, 0.9, producer_risk=0.1)
        decision = is_rejected(attacks, requirement)
        rejected += decision
        any_alone += any(
            evidence_above(lost / found, 0.2) >= 10 for found, lost in attacks.values()
        )
    assert any_alone >= 3
    assert rejected == 0


def is_rejected(attacks, requirement):
    """Whether the evidence rejects; without bounds and acceptance, which take longer."""
    mean = np.mean(
        [evidence_above(lost / found, requirement.accept) for found, lost in attacks.values()]
    )
    return mean >= 1 / requirement.producer_risk


def paints(hidden):
    """62 paints on 18 tiles: the first hides this share, all others next to nothing."""
    found, lost = simulate(hidden, 18, runs=1)
    return {str(i): (found[0], lost[0] if i == 0 else (found[0] > 10) * 1) for i in range(62)}


def test_one_plain_paint_rejects_before_any_attack_and_after_those_that_hide_nothing():
    painted = paints(0.9)
    found, lost = simulate(0.05, 40, runs=1)
    for attacks in ({}, {"T-U": (found[0], lost[0])}):
        decision = decide(attacks, Requirement(0.2, 0.3), painted, paints_tried=62)
        assert decision.answer == "rejected"
        assert set(decision.attacks) == set(attacks)
        name, said = decision.paint
        assert name == "0"
        assert 0.2 < said.at_least < said.share <= said.at_most
    harmless = paints(0.05)
    assert decide({}, Requirement(0.2, 0.3), harmless, paints_tried=62).answer == "undecided"
    assert decide({}, Requirement(0.2, 0.3), paints_tried=62).answer == "undecided"
    attacks = {"T-U": (found[0], lost[0])}
    accepted = decide(attacks, Requirement(0.2, 0.3), harmless, paints_tried=62)
    assert (accepted.answer, accepted.paint) == ("accepted", None)


def test_the_choice_of_the_worst_of_many_paints_adds_no_risk():
    """All paints hide what is allowed: the worst alone would reject far too often."""
    requirement = Requirement(0.2, 0.3, producer_risk=0.3)
    wrong = alone = 0
    for seed in range(40):
        found, lost = simulate(0.2, 18, runs=62, seed=seed)
        painted = {str(i): (found[i], lost[i]) for i in range(62)}
        wrong += decide({}, requirement, painted, paints_tried=62).answer == "rejected"
        worst = max(float(evidence_above(b / a, 0.2)) for a, b in painted.values())
        alone += worst >= 1 / requirement.producer_risk
    assert alone > 0.5 * 40
    # A fifth of the producer's risk is 2.4 of 40.
    assert wrong <= 2


def test_attacks_and_paints_share_the_risk_of_the_producer():
    """Evidence that just rejects alone does not with paints: both could err."""
    found = np.full(40, 50)
    requirement = Requirement(0.2, 0.21)
    least = next(lost for lost in range(400, 500) if rejects(attack(found, lost), requirement))
    evidence = decide(attack(found, least), requirement).attacks["T-U"].for_rejection
    assert 20 <= evidence < 25
    assert decide(attack(found, least), requirement, paints_tried=62).answer == "undecided"


def attack(found, lost):
    """An attack that hides so many vehicles, evenly over the tiles."""
    even = np.full(len(found), lost // len(found))
    even[: lost % len(found)] += 1
    return {"T-U": (found, even)}


def rejects(attacks, requirement):
    return decide(attacks, requirement).answer == "rejected"


def test_what_is_undecided_says_how_many_tiles_decide():
    found, lost = simulate(0.15, 12, runs=1, seed=3)
    attacks = {"T-U": (found[0], lost[0])}
    decision = decide(attacks, Requirement(0.2, 0.3))
    assert decision.answer == "undecided"
    assert decision.more_tiles > 0
    # As many tiles like these do decide, a quarter fewer do not.
    for times, decided in ((1.0, True), (0.7, False)):
        tiles = round(12 + times * decision.more_tiles)
        again = np.resize(np.arange(12), tiles)
        repeated = {"T-U": (found[0][again], lost[0][again])}
        assert (decide(repeated, Requirement(0.2, 0.3)).answer != "undecided") == decided


def test_a_rate_between_the_two_shares_may_never_be_decided_soon():
    found = np.full(40, 8)
    decision = decide({"T-U": (found, found // 4)}, Requirement(0.24, 0.26))
    assert decision.answer == "undecided"
    assert decision.more_tiles > 50


def test_the_order_of_the_tiles_does_not_matter():
    found, lost = simulate(0.2, 30, runs=1)
    order = np.random.default_rng(1).permutation(30)
    first = decide({"T-U": (found[0], lost[0])}, Requirement(0.2, 0.3))
    second = decide({"T-U": (found[0][order], lost[0][order])}, Requirement(0.2, 0.3))
    assert second.attacks["T-U"].for_acceptance == pytest.approx(
        first.attacks["T-U"].for_acceptance
    )


def test_tiles_without_found_vehicles_say_nothing():
    found, lost = simulate(0.1, 30, runs=1)
    more = (np.append(found[0], [0, 0]), np.append(lost[0], [0, 0]))
    requirement = Requirement(0.2, 0.3)
    assert decide({"T-U": more}, requirement) == decide({"T-U": (found[0], lost[0])}, requirement)


@pytest.mark.parametrize("reject", [0.001, 0.01, 0.05, 0.3, 0.75, 1.0])
def test_the_fewest_tiles_accept_and_one_less_does_not(reject):
    for risk in (0.01, 0.05, 0.2):
        fewest = fewest_tiles(reject, risk)
        assert evidence_below(np.zeros(fewest), reject) >= (1 - 1e-9) / risk
        assert evidence_below(np.zeros(fewest - 1), reject) < (1 + 1e-9) / risk


def test_the_fewest_tiles_are_known_at_once_even_where_nobody_could_fly_them():
    assert 10**9 < fewest_tiles(1e-9, 0.05) < 10**11


def test_the_borders_of_the_range():
    found = np.full(40, 5)
    assert decide({"a": (found, 0 * found)}, Requirement(0.0, 0.1)).answer == "accepted"
    assert decide({"a": (found, found)}, Requirement(0.9, 1.0)).answer != "accepted"
    assert decide({"a": (found, found)}, Requirement(0.5, 1.0)).answer == "rejected"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((0.3, 0.2), "exchange them"),
        ((0.2, 0.2), "set them apart"),
        ((-0.1, 0.2), "accept"),
        ((0.1, 1.2), "reject"),
        ((0.1, 0.2, 0.7), "producer"),
        ((0.1, 0.2, 0.05, 0.0), "consumer"),
    ],
)
def test_impossible_requirements_are_refused(arguments, word):
    with pytest.raises(ConfigurationError, match=word):
        Requirement(*arguments)


@pytest.mark.parametrize("attacks", [{}, {"T-U": (np.zeros(3, int), np.zeros(3, int))}])
def test_no_decision_from_nothing(attacks):
    with pytest.raises(ConfigurationError, match="at least one attack"):
        decide(attacks, Requirement(0.2, 0.3))
