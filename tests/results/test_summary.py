"""The table of results, counted by hand."""

import dataclasses
import json
from typing import get_type_hints

import pytest

from skyproof.results import result
from skyproof.results.outcomes import Outcome
from skyproof.results.score_folder import SetScore
from skyproof.results.statistics.contrasts import mcnemar_p
from skyproof.results.statistics.repeats import DRAWS, SEEDS
from tests.results.counted import count_outcomes

REQUIRED = [
    "camouflage",
    "renderer",
    "detector",
    "vehicles",
    "easr",
    "easr_low",
    "easr_high",
    "net_easr",
    "net_easr_low",
    "net_easr_high",
    "asr",
    "er",
    "ap_original",
    "ap_adversarial",
    "apd",
    "match",
]


def summarise(tiles, sets, *, seed):
    """The rows as `results.json` has them."""
    return [row.json() for row in result.summarise(tiles, sets, seed=seed)]


def outcomes(camouflage, detector, detected, match="centre_1m"):
    """Vehicles as (original, adversarial), two on each tile."""
    blank = {
        name: {str: "x", int: 0, bool: False, float: 0.0}[kind]
        for name, kind in get_type_hints(Outcome).items()
    }
    return [
        Outcome(
            **(
                blank
                | {
                    "scene": f"s{i // 2}",
                    "background": f"tile-{i // 2}",
                    "placement": i % 2,
                    "camouflage": camouflage,
                    "renderer": "torch",
                    "detector": detector,
                    "match": match,
                    "detected_original": bool(before),
                    "detected_adversarial": bool(after),
                }
            )
        )
        for i, (before, after) in enumerate(detected)
    ]


@pytest.fixture
def rows():
    attack_a = [(1, 0)] * 14 + [(1, 1)] * 4 + [(0, 1)] * 1 + [(0, 0)] * 1
    attack_b = [(1, 0)] * 8 + [(1, 1)] * 8 + [(0, 0)] * 4
    random_a0 = [(1, 0)] * 2 + [(1, 1)] * 16 + [(0, 0)] * 2
    random_a1 = [(1, 0)] * 1 + [(1, 1)] * 17 + [(0, 1)] * 1 + [(0, 0)] * 1
    random_b = [(1, 0)] * 4 + [(1, 1)] * 12 + [(0, 0)] * 4
    found = outcomes("T-U", "retinanet", attack_a) + outcomes("T-U", "yolov5", attack_b)
    found += outcomes("R-U-0", "retinanet", random_a0) + outcomes("R-U-1", "retinanet", random_a1)
    found += outcomes("R-U-0", "yolov5", random_b) + outcomes("R-U-1", "yolov5", random_b)
    found += outcomes("T-U", "retinanet", attack_b, "iou_50")
    sets = [
        SetScore("original", "torch", "retinanet", "centre_1m", 0.9, 10.0),
        SetScore("T-U", "torch", "retinanet", "centre_1m", 0.3, 30.0),
        SetScore("R-U-0", "torch", "retinanet", "centre_1m", 0.8, 12.0),
        SetScore("R-U-1", "torch", "retinanet", "centre_1m", 0.7, 14.0),
    ]
    made = summarise(count_outcomes(found), sets, seed=0)
    return {(row["camouflage"], row["detector"], row["match"]): row for row in made}


def test_rates(rows):
    row = rows["T-U", "retinanet", "centre_1m"]
    assert row["vehicles"] == 20
    assert row["clusters"] == 10
    assert row["asr"] == pytest.approx(14 / 18)
    assert row["er"] == pytest.approx(1 / 18)
    assert row["easr"] == pytest.approx(13 / 18)
    assert row["easr_low"] < row["easr"] < row["easr_high"] <= 1
    assert row["random_easr"] == pytest.approx((2 / 18 + 0 / 18) / 2)
    assert row["net_easr"] == pytest.approx(13 / 18 - 1 / 18)
    assert row["net_easr_low"] < row["net_easr"] < row["net_easr_high"]


def test_mean_is_unweighted_over_detectors(rows):
    row = rows["T-U", "mean", "centre_1m"]
    assert row["easr"] == pytest.approx((13 / 18 + 8 / 16) / 2)
    assert row["net_easr"] == pytest.approx((13 / 18 + 8 / 16) / 2 - (1 / 18 + 4 / 16) / 2)
    # One detector without scores leaves the mean AP undefined, not the mean of the others.
    assert row["ap_original"] is None
    assert row["no_camouflage_p"] is None
    assert 0 < row["control_p"] < 0.05


def test_random_draws_share_a_row(rows):
    row = rows["R-U", "retinanet", "centre_1m"]
    assert row["repeats"] == 2
    assert row["easr"] == pytest.approx((2 / 18 + 0) / 2)
    assert row["ap_adversarial"] == pytest.approx(0.75)
    assert row["net_easr"] is None
    assert not any(camouflage == "R-U-0" for camouflage, _, _ in rows)


def test_average_precision_difference_and_false_alarms(rows):
    row = rows["T-U", "retinanet", "centre_1m"]
    assert row["apd"] == pytest.approx(0.6)
    assert (row["false_alarms_per_km2_original"], row["false_alarms_per_km2_adversarial"]) == (
        10.0,
        30.0,
    )


def test_two_questions_are_tested(rows):
    row = rows["T-U", "retinanet", "centre_1m"]
    assert row["no_camouflage_p"] == pytest.approx(mcnemar_p(14, 1))
    # The larger of the two draws' p. T-U loses 2 on each of the first seven tiles and gains 1 on
    # the last; R-U-0 loses 2 on the first. Six times 2 and once -1 are left: of all swaps, four
    # give 11 or more, either way. Against R-U-1 only two give as much as it does.
    assert row["control_p"] == 4 / 2**7
    control = rows["R-U", "retinanet", "centre_1m"]
    assert control["control_p"] is control["no_camouflage_p"] is None
    # Without a control there is nothing to test against.
    assert rows["T-U", "retinanet", "iou_50"]["control_p"] is None


def test_the_strongest_strongest_control_counts_and_the_lowest_limit():
    # Of 20 vehicles, two on each tile; the paint hides whole tiles, the search one of two.
    hidden = {
        "T-Ma": range(16),
        "R-Ma-0": [],
        "R-Ma_plain": range(10),
        "R-Ma_search": range(0, 16, 2),
        "R-Pix_best": range(20),
    }
    found = [
        outcome
        for name, lost in hidden.items()
        for outcome in outcomes(name, "a", [(1, 0 if i in lost else 1) for i in range(20)])
    ]
    made = result.summarise(count_outcomes(found), [], seed=0)
    row = {str(row.camouflage): row for row in made}["T-Ma"]
    assert (str(row.strongest.control), row.strongest.easr) == ("R-Ma_plain", 0.5)
    assert row.strongest.net.estimate == pytest.approx(0.3)
    # Against the search it hides more, but as surely: a vehicle on each of eight tiles.
    alone = {
        control: next(
            row.strongest
            for row in result.summarise(
                count_outcomes([one for one in found if one.camouflage in ("T-Ma", control)]),
                [],
                seed=1,
            )
            if str(row.camouflage) == "T-Ma"
        )
        for control in ("R-Ma_plain", "R-Ma_search")
    }
    lowest = min(each.net.low for each in alone.values())
    assert row.strongest.net.low == pytest.approx(lowest, abs=0.02)
    # Six vehicles on three tiles: of eight swaps, two are as uneven; of two to the eighth, two.
    assert alone["R-Ma_plain"].p == 2 / 2**3
    assert alone["R-Ma_search"].p == 2 / 2**8
    assert row.strongest.p == 2 / 2**3
    assert row.random.p == 2 / 2**8
    # What belongs to other constraints is no control of this one, and controls have none.
    others = [one for one in made if str(one.camouflage) != "T-Ma"]
    assert all(one.strongest is None and one.random is None for one in others)


def test_a_single_draw_that_hides_more_than_the_chosen_controls_is_the_strongest():
    hidden = {"T-Ma": 16, "R-Ma-0": 0, "R-Ma-1": 12, "R-Ma_plain": 4, "R-Ma_best": 6}
    found = [
        outcome
        for name, lost in hidden.items()
        for outcome in outcomes(name, "a", [(1, int(i >= lost)) for i in range(20)])
    ]
    made = result.summarise(count_outcomes(found), [], seed=0)
    strongest = {str(row.camouflage): row for row in made}["T-Ma"].strongest
    assert (str(strongest.control), strongest.easr, strongest.draws) == ("R-Ma-1", 0.6, 1)
    assert strongest.net.estimate == pytest.approx(0.2)
    # This draw stands for itself. As the random control a single draw stands for all others, too.
    assert {*strongest.net.errors} == {"tiles", "seeds"}
    alone = [one for one in found if one.camouflage in ("T-Ma", "R-Ma-1")]
    (row, _) = result.summarise(count_outcomes(alone), [], seed=0)
    assert "draws" in row.random.net.errors
    # Two tiles differ, so of four swaps two are as uneven.
    assert strongest.p == 2 / 2**2
    # Draws alone were not chosen, so they say nothing of what optimisation adds.
    alone = [one for one in found if one.camouflage in ("T-Ma", "R-Ma-0", "R-Ma-1")]
    made = result.summarise(count_outcomes(alone), [], seed=0)
    assert all(row.strongest is None for row in made)


def test_a_combination_stands_beside_its_texture_under_random_shapes():
    hidden = {"C-Fc-seq@0.2-0": 15, "R-C-Fc-seq@0.2-0": 8, "R-C-Fc-seq@0.2-1": 10, "R-C-Fc@0.2": 2}
    found = [
        outcome
        for name, count in hidden.items()
        for outcome in outcomes(name, "a", [(1, 0)] * count + [(1, 1)] * (20 - count))
    ]
    rows = {row["camouflage"]: row for row in summarise(count_outcomes(found), [], seed=0)}
    row = rows["C-Fc-seq@0.2"]
    assert row["drawn_shape_easr"] == pytest.approx(9 / 20)
    assert row["net_drawn_shape_easr"] == pytest.approx(6 / 20)
    assert row["random_easr"] == pytest.approx(2 / 20)
    assert row["strongest_control"] is row["net_strongest_control_easr"] is None


def test_holm_runs_over_the_camouflages_of_one_detector():
    lost = {"T-U": 14, "T-Pix": 9, "R-U-0": 2, "R-Pix-0": 1}
    found = [
        outcome
        for detector in ("a", "b")
        for name, count in lost.items()
        for outcome in outcomes(name, detector, [(1, 0)] * count + [(1, 1)] * (20 - count))
    ]
    made = summarise(count_outcomes(found), [], seed=0)
    rows = {(row["camouflage"], row["detector"]): row for row in made}
    for detector in ("a", "b"):
        first, second = rows["T-U", detector], rows["T-Pix", detector]
        for test, smaller, larger in (
            ("control_p", 2 / 2**6, 2 / 2**5),
            ("no_camouflage_p", 2 / 2**14, 2 / 2**9),
        ):
            assert (first[test], second[test]) == pytest.approx((smaller, larger))
            assert first[f"{test}_holm"] == pytest.approx(2 * smaller)
            assert second[f"{test}_holm"] == pytest.approx(larger)


def test_a_row_says_what_its_intervals_are_made_of():
    lost = {"T-U-0": 14, "T-U-1": 10, "R-U-0": 2, "R-U-1": 1}
    found = [
        outcome
        for name, count in lost.items()
        for outcome in outcomes(name, "a", [(1, 0)] * count + [(1, 1)] * (20 - count))
    ]
    made = summarise(count_outcomes(found), [], seed=0)
    rows = {row["camouflage"]: row for row in made}
    # Two seeds, 0.7 and 0.5.
    assert rows["T-U"]["easr_repeat_se"] == pytest.approx(0.1)
    # Two draws, 0.1 and 0.05, are nearer than draws usually are.
    draws = DRAWS.usual_sd / 2**0.5
    assert rows["T-U"]["random_draw_se"] == rows["R-U"]["easr_repeat_se"] == pytest.approx(draws)
    assert rows["R-U"]["random_draw_se"] is None
    assert rows["T-U"]["easr_tile_se"] > 0.1
    # All vehicles are the same one.
    assert rows["T-U"]["easr_vehicle_se"] is None
    fleet = [dataclasses.replace(each, vehicle=f"car-{each.scene}") for each in found]
    made = summarise(count_outcomes(fleet), [], seed=0)
    # Where each vehicle stands on one tile, it adds nothing to the tile.
    assert made[0]["easr_vehicle_se"] == pytest.approx(0, abs=1e-9)
    found = [each for each in found if not each.camouflage.endswith("1")]
    alone = summarise(count_outcomes(found), [], seed=0)[0]
    assert alone["easr_repeat_se"] == SEEDS.largest_sd
    assert alone["random_draw_se"] == DRAWS.largest_sd


def test_both_matches_and_the_keys(rows):
    row = rows["T-U", "retinanet", "iou_50"]
    assert row["net_easr"] is None
    for row in rows.values():
        assert set(REQUIRED) <= set(row)
        json.dumps(row, allow_nan=False)


def test_a_net_interval_is_no_surer_than_its_unanimous_part():
    # Every vehicle is hidden on all 20 tiles: resampling sees no spread, the exact limit is 1 -
    # 0.025 ** (1 / 20).
    # A camouflage of the user's has no seed.
    found = outcomes("mine-U", "retinanet", [(1, 0)] * 40)
    found += outcomes("R-U-0", "retinanet", [(1, 0), (1, 1), (1, 1), (1, 1)] * 10)
    row = next(
        row for row in summarise(count_outcomes(found), [], seed=0) if row["camouflage"] == "mine-U"
    )
    margin = 1 - 0.025 ** (1 / 20)
    assert row["easr_low"] == pytest.approx(1 - margin)
    assert row["net_easr"] == pytest.approx(0.75)
    assert row["net_easr_low"] < 0.75 - margin


def test_a_mean_is_no_surer_than_a_unanimous_part():
    # One detector loses everything on all 20 tiles, the other all but one vehicle.
    found = outcomes("mine-U", "retinanet", [(1, 0)] * 40) + outcomes(
        "mine-U", "yolov5", [(1, 0)] * 39 + [(1, 1)]
    )
    rows = {row["detector"]: row for row in summarise(count_outcomes(found), [], seed=0)}
    margins = [rows[name]["easr"] - rows[name]["easr_low"] for name in ("retinanet", "yolov5")]
    assert margins[0] == pytest.approx(1 - 0.025 ** (1 / 20))
    assert rows["mean"]["easr_low"] == pytest.approx(rows["mean"]["easr"] - sum(margins) / 2)


def test_undefined_becomes_null():
    found = outcomes("T-U", "retinanet", [(0, 1), (0, 0)] * 3)
    (row,) = summarise(count_outcomes(found), [], seed=0)
    assert row["easr"] is None
    assert row["easr_low"] is None
    json.dumps(row, allow_nan=False)


def test_same_seed_same_rows():
    found = outcomes("T-U", "retinanet", [(1, 0), (1, 1), (1, 1), (0, 1)] * 5)
    assert summarise(count_outcomes(found), [], seed=2) == summarise(
        count_outcomes(found), [], seed=2
    )


@pytest.fixture
def repeated():
    """Makes two seeds of one attack before two detectors.

    The second seed gains vehicles before yolov5.
    """
    seeds = {
        ("T-Pix-0", "retinanet"): [(1, 0)] * 12 + [(1, 1)] * 8,
        ("T-Pix-1", "retinanet"): [(1, 0)] * 8 + [(1, 1)] * 12,
        ("T-Pix-0", "yolov5"): [(1, 0)] * 5 + [(1, 1)] * 5 + [(0, 0)] * 10,
        ("T-Pix-1", "yolov5"): [(1, 1)] * 10 + [(0, 1)] * 5 + [(0, 0)] * 5,
        ("R-Pix-0", "retinanet"): [(1, 0)] * 2 + [(1, 1)] * 18,
        ("R-Pix-0", "yolov5"): [(1, 1)] * 10 + [(0, 0)] * 10,
    }
    found = [
        o
        for (name, detector), detected in seeds.items()
        for o in outcomes(name, detector, detected)
    ]
    return {
        (row["camouflage"], row["detector"]): row
        for row in summarise(count_outcomes(found), [], seed=0)
    }


def test_repeats_share_a_row_and_their_spread_is_said(repeated):
    row = repeated["T-Pix", "retinanet"]
    assert row["repeats"] == 2
    assert row["easr"] == pytest.approx((12 / 20 + 8 / 20) / 2)
    assert (row["easr_repeat_min"], row["easr_repeat_max"]) == (
        pytest.approx(0.4),
        pytest.approx(0.6),
    )
    assert row["easr_repeat_sd"] == pytest.approx(0.2 / 2**0.5)
    assert row["net_easr"] == pytest.approx(0.5 - 0.1)
    mean = repeated["T-Pix", "mean"]
    # Per seed the mean over detectors: (0.6 + 0.5) / 2 and (0.4 - 0.5) / 2.
    assert mean["easr"] == pytest.approx((0.55 - 0.05) / 2)
    assert (mean["easr_repeat_min"], mean["easr_repeat_max"]) == (
        pytest.approx(-0.05),
        pytest.approx(0.55),
    )
    assert repeated["R-Pix", "retinanet"]["easr_repeat_sd"] is None


def test_mcnemar_holds_for_every_repeat(repeated):
    assert repeated["T-Pix", "retinanet"]["no_camouflage_p"] == pytest.approx(mcnemar_p(8, 0))
    # One seed loses five, the other gains five: nothing can be claimed of both.
    assert repeated["T-Pix", "yolov5"]["no_camouflage_p"] == 1
    assert repeated["R-Pix", "retinanet"]["no_camouflage_p"] is None
