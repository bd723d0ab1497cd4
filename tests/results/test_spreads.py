"""The assumed standard deviations of repeats are those of the tables in docs/results."""

import csv
import math
from pathlib import Path

import pytest

from skyproof.results.outcomes import repeat_of
from skyproof.results.statistics.repeats import (
    BESTS,
    DRAWS,
    GIVEN,
    SEARCHES,
    SEEDS,
    TRAININGS,
)

TABLES = Path(__file__).parents[2] / "docs" / "results"
_ATTACKED = ("seed_0/textures", "seed_0/curves")
_MEASURED = (*_ATTACKED, "seed_0/judges")
# The mean range of ten normal values, in standard deviations.
_RANGE_OF_TEN = 3.078


def rows(name):
    with (TABLES / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        # Combinations without a change of shape are the textures again.
        return [row for row in csv.DictReader(file) if row.get("pm") != "0"]


def of_seeds(tables=_MEASURED):
    """Standard deviations of three seeds each, which follow from their ends and mean."""
    for row in (row for name in tables for row in rows(name)):
        if row["repeats"] == "3":
            low, mean, high = (
                float(row[name]) for name in ("easr_repeat_min", "easr", "easr_repeat_max")
            )
            parts = (low - mean, 2 * mean - low - high, high - mean)
            yield math.sqrt(sum(part**2 for part in parts) / 2) / 100


def of_draws():
    for row in (row for name in _MEASURED for row in rows(name)):
        if row["attack"].startswith("R-") and row["repeats"] == "10":
            apart = float(row["easr_repeat_max"]) - float(row["easr_repeat_min"])
            yield apart / _RANGE_OF_TEN / 100


def of_trainings():
    return (float(row["easr_training_sd"]) / 100 for row in rows("trainings/trainings"))


@pytest.mark.parametrize(
    ("kind", "measured"), [(SEEDS, of_seeds), (DRAWS, of_draws), (TRAININGS, of_trainings)]
)
def test_spreads_are_those_of_the_tables(kind, measured):
    found = list(measured())
    assert len(found) > 20
    usual = math.sqrt(sum(each**2 for each in found) / len(found))
    assert kind.usual_sd == pytest.approx(usual, rel=0.05)
    # Held-out detectors tell seeds apart more than attacked ones do.
    largest = max(of_seeds(_ATTACKED) if kind is SEEDS else found)
    assert largest <= kind.largest_sd <= 1.05 * largest


def test_the_best_of_32_draws_spreads_half_as_much_as_one(rng):
    largest = rng.normal(size=(20_000, 32)).max(axis=1).std()
    for best, single in (
        (BESTS.usual_sd, DRAWS.usual_sd),
        (BESTS.largest_sd, DRAWS.largest_sd),
    ):
        assert best == pytest.approx(largest * single, rel=0.05)


def test_pairs_of_searches():
    """EASR of two starts each, by images a step (docs/attacks.md, commit 37a385d)."""
    eight = [(34, 30), (13, 52), (27, -1)]
    others = [
        *[(17, 28), (10, 17), (0, -1)],
        *[(36, 26), (33, 26), (27, -1)],
        *[(6, 29), (16, 31), (28, 10)],
    ]

    def spread(pairs):
        return math.sqrt(sum((a - b) ** 2 / 2 for a, b in pairs) / len(pairs)) / 100

    assert SEARCHES.usual_sd == pytest.approx(spread(eight + others), rel=0.05)
    assert SEARCHES.largest_sd == pytest.approx(spread(eight), rel=0.05)


@pytest.mark.parametrize(
    ("name", "of", "number", "kind"),
    [
        ("T-U-2", "T-U", "2", SEEDS),
        ("R-U-1", "R-U", "1", DRAWS),
        ("R-PixFc_search-4", "R-PixFc_search", "4", SEARCHES),
        ("R-PixFc_search", "R-PixFc_search", "", SEARCHES),
        ("R-PixFc_best", "R-PixFc_best", "", BESTS),
        ("R-U_plain", "R-U_plain", "", GIVEN),
        ("my net", "my net", "", GIVEN),
    ],
)
def test_names_say_what_is_a_repeat_of_what(name, of, number, kind):
    repeat = repeat_of(name)
    assert (repeat.of, repeat.number, repeat.kind) == (of, number, kind)


def test_the_spreads_in_the_conventions_are_those_of_the_code():
    text = " ".join((TABLES.parent / "conventions.md").read_text().split())
    kinds = (SEEDS, DRAWS, SEARCHES, TRAININGS)
    usual = ", ".join(f"{kind.usual_sd:g}" for kind in kinds)
    first, *others = (f"{kind.largest_sd:g}" for kind in kinds)
    largest = (
        f"({first} on attacked detectors, {', '.join(others)}; best-of-N {BESTS.largest_sd:g})"
    )
    assert f"usual standard deviation ({usual})" in text
    assert largest in text
