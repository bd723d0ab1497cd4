"""Decisions keep their risks, on tiles whose vehicles fare alike, however often one looks."""

from dataclasses import replace

import numpy as np
import pytest

from skyproof.errors import ConfigurationError
from skyproof.results.statistics.acceptance import (
    Requirement,
    Tiles,
    decide,
    evidence_above,
    evidence_below,
    fewest_tiles,
)

RUNS = 300


def tiles_of(found, lost, most=11):
    """Tiles of one scene each, with up to so many vehicles."""
    return Tiles(np.ones_like(found), found, lost, most)


def simulate(rate, tiles, *, correlation=0.1, runs=RUNS, seed=0):
    """Vehicles found and lost per tile; 2 to 11 of them fare alike."""
    generator = np.random.default_rng(seed)
    found = generator.integers(2, 12, (runs, tiles))
    certainty = 1 / correlation - 1
    inside = generator.beta(rate * certainty, (1 - rate) * certainty, (runs, tiles))
    return tiles_of(found, generator.binomial(found, inside))


def of_run(tiles, run=0):
    """One of some simulated tests."""
    return replace(tiles, scenes=tiles.scenes[run], found=tiles.found[run], lost=tiles.lost[run])


def ever(evidence, tiles, limit, risk):
    """How often the evidence reaches 1/risk at any of some looks at the growing test."""
    looks = range(5, tiles.found.shape[1] + 1, 5)
    seen = [tiles_of(tiles.found[:, :many], tiles.lost[:, :many], tiles.most) for many in looks]
    reached = [evidence(each, limit) >= 1 / risk for each in seen]
    return np.any(reached, axis=0).mean()


@pytest.mark.parametrize("correlation", [0.02, 0.1, 0.4])
@pytest.mark.parametrize(("good", "bad", "risk"), [(0.2, 0.3, 0.05), (0.05, 0.1, 0.1)])
def test_both_risks_hold_though_one_looks_again_and_again(good, bad, risk, correlation):
    for rate, evidence, limit in ((bad, evidence_below, bad), (good, evidence_above, good)):
        tiles = simulate(rate, 150, correlation=correlation)
        # 300 runs: three standard errors are 3.8 and 5.2 points.
        allowed = risk + 3 * np.sqrt(risk * (1 - risk) / RUNS)
        assert ever(evidence, tiles, limit, risk) <= allowed


def test_independent_trials_would_not_hold_them():
    """Why tiles are the trials: a binomial test of the same vehicles errs far too often."""
    from scipy import stats

    tiles = simulate(0.3, 60, correlation=0.4)
    wrong = stats.binom.cdf(tiles.lost.sum(1), tiles.found.sum(1), 0.3) <= 0.05
    assert wrong.mean() > 0.1
    assert (evidence_below(tiles, 0.3) >= 20).mean() <= 0.05


@pytest.mark.parametrize(("rate", "answer"), [(0.1, "accepted"), (0.45, "rejected")])
def test_clear_cases_are_decided(rate, answer):
    tiles = simulate(rate, 40, runs=1)
    decision = decide({"T-U": of_run(tiles)}, Requirement(0.2, 0.3))
    assert (decision.answer, decision.more_tiles) == (answer, 0)
    said = decision.attacks["T-U"]
    assert said.at_least < said.share < said.at_most
    assert (said.found, said.lost) == (tiles.found.sum(), tiles.lost.sum())
    assert said.share == said.lost / said.found
    if answer == "accepted":
        assert said.at_most < 0.3
        assert said.for_acceptance >= 20
    else:
        assert said.at_least > 0.2
        assert said.for_rejection >= 20


def test_the_worst_attack_decides():
    weak = of_run(simulate(0.05, 40, runs=1))
    strong = of_run(simulate(0.6, 40, runs=1))
    requirement = Requirement(0.2, 0.3)
    assert decide({"weak": weak}, requirement).answer == "accepted"
    assert decide({"weak": weak, "strong": strong}, requirement).answer == "rejected"


def test_one_of_many_attacks_rejects_only_with_as_much_more_evidence():
    """Some attack among twenty passes the line by chance; their mean does not."""
    every = [simulate(0.2, 40, runs=RUNS, seed=seed) for seed in range(20)]
    rejected = any_alone = 0
    for run in range(100):
        attacks = {str(number): of_run(tiles, run) for number, tiles in enumerate(every)}
        requirement = Requirement(0.2, 0.9, producer_risk=0.1)
        decision = is_rejected(attacks, requirement)
        rejected += decision
        any_alone += any(evidence_above(tiles, 0.2) >= 10 for tiles in attacks.values())
    assert any_alone >= 3
    assert rejected == 0


def is_rejected(attacks, requirement):
    """Whether the evidence rejects; without bounds and acceptance, which take longer."""
    mean = np.mean([evidence_above(tiles, requirement.accept) for tiles in attacks.values()])
    return mean >= 1 / requirement.producer_risk


def paints(hidden):
    """62 paints on 18 tiles: the first hides this share, all others next to nothing."""
    first = of_run(simulate(hidden, 18, runs=1))
    return {"0": first} | {
        str(number): replace(first, lost=(first.found > 10) * 1) for number in range(1, 62)
    }


def test_one_plain_paint_rejects_before_any_attack_and_after_those_that_hide_nothing():
    painted = paints(0.9)
    attacked = {"T-U": of_run(simulate(0.05, 40, runs=1))}
    for attacks in ({}, attacked):
        decision = decide(attacks, Requirement(0.2, 0.3), painted, paints_tried=62)
        assert decision.answer == "rejected"
        assert set(decision.attacks) == set(attacks)
        name, said = decision.paint
        assert name == "0"
        assert 0.2 < said.at_least < said.share <= said.at_most
    harmless = paints(0.05)
    assert decide({}, Requirement(0.2, 0.3), harmless, paints_tried=62).answer == "undecided"
    assert decide({}, Requirement(0.2, 0.3), paints_tried=62).answer == "undecided"
    accepted = decide(attacked, Requirement(0.2, 0.3), harmless, paints_tried=62)
    assert (accepted.answer, accepted.paint) == ("accepted", None)


def test_the_choice_of_the_worst_of_many_paints_adds_no_risk():
    """All paints hide what is allowed: the worst alone would reject far too often."""
    requirement = Requirement(0.2, 0.3, producer_risk=0.3)
    wrong = alone = 0
    for seed in range(40):
        tiles = simulate(0.2, 18, runs=62, seed=seed)
        painted = {str(number): of_run(tiles, number) for number in range(62)}
        wrong += decide({}, requirement, painted, paints_tried=62).answer == "rejected"
        worst = max(float(evidence_above(each, 0.2)) for each in painted.values())
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
    return {"T-U": tiles_of(found, even, 50)}


def rejects(attacks, requirement):
    return decide(attacks, requirement).answer == "rejected"


def test_what_is_undecided_says_how_many_tiles_decide():
    first = of_run(simulate(0.15, 12, runs=1, seed=3))
    decision = decide({"T-U": first}, Requirement(0.2, 0.3))
    assert decision.answer == "undecided"
    assert decision.more_tiles > 0
    # As many tiles like these do decide, a quarter fewer do not.
    for times, decided in ((1.0, True), (0.7, False)):
        tiles = round(12 + times * decision.more_tiles)
        again = np.resize(np.arange(12), tiles)
        repeated = {"T-U": tiles_of(first.found[again], first.lost[again])}
        assert (decide(repeated, Requirement(0.2, 0.3)).answer != "undecided") == decided


def test_a_rate_between_the_two_shares_may_never_be_decided_soon():
    found = np.full(40, 8)
    decision = decide({"T-U": tiles_of(found, found // 4, 8)}, Requirement(0.24, 0.26))
    assert decision.answer == "undecided"
    assert decision.more_tiles > 50


def test_the_order_of_the_tiles_does_not_matter():
    tiles = of_run(simulate(0.2, 30, runs=1))
    order = np.random.default_rng(1).permutation(30)
    turned = tiles_of(tiles.found[order], tiles.lost[order])
    first = decide({"T-U": tiles}, Requirement(0.2, 0.3))
    second = decide({"T-U": turned}, Requirement(0.2, 0.3))
    assert second.attacks["T-U"].for_acceptance == pytest.approx(
        first.attacks["T-U"].for_acceptance
    )


def test_tiles_without_found_vehicles_say_nothing():
    tiles = of_run(simulate(0.1, 40, runs=1))
    more = tiles_of(np.append(tiles.found, [0, 0]), np.append(tiles.lost, [0, 0]))
    requirement = Requirement(0.2, 0.3)
    assert decide({"T-U": more}, requirement) == decide({"T-U": tiles}, requirement)


@pytest.mark.parametrize("reject", [0.001, 0.01, 0.05, 0.3, 0.75, 1.0])
def test_the_fewest_tiles_accept_and_one_less_does_not(reject):
    for risk in (0.01, 0.05, 0.2):
        fewest = fewest_tiles(reject, risk)
        assert evidence_below(nothing_lost(fewest), reject) >= (1 - 1e-9) / risk
        if fewest > 1:
            assert evidence_below(nothing_lost(fewest - 1), reject) < (1 + 1e-9) / risk


def nothing_lost(tiles):
    """So many tiles with a scene of 3 vehicles, of 5 at most."""
    return tiles_of(np.full(tiles, 3), np.zeros(tiles), 5)


def test_the_fewest_tiles_are_known_at_once_even_where_nobody_could_fly_them():
    assert 10**9 < fewest_tiles(1e-9, 0.05) < 10**11


def test_the_borders_of_the_range():
    found = np.full(40, 5)
    none, all_lost = (tiles_of(found, times * found, 5) for times in (0, 1))
    assert decide({"a": none}, Requirement(0.0, 0.1)).answer == "accepted"
    assert decide({"a": all_lost}, Requirement(0.9, 1.0)).answer != "accepted"
    assert decide({"a": all_lost}, Requirement(0.5, 1.0)).answer == "rejected"


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


@pytest.mark.parametrize("attacks", [{}, {"T-U": tiles_of(np.zeros(3, int), np.zeros(3, int))}])
def test_no_decision_from_nothing(attacks):
    with pytest.raises(ConfigurationError, match="at least one attack"):
        decide(attacks, Requirement(0.2, 0.3))
