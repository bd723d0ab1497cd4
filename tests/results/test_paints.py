"""Plain paints of the precheck beside an optimised camouflage."""

import math

import pytest

from skyproof.results.paints import beside_paints
from skyproof.results.precheck import MeasuredOn, PrecheckRecord, Rate
from skyproof.results.result import MEAN
from skyproof.results.statistics.intervals import Interval
from tests.results.rows import beside, made_row

EASR = Interval(0.5, 0.4, 0.6)
SEARCHED = Interval(0.4, 0.3, 0.5)


def record(**hidden):
    """A precheck with one paint of each of these kinds."""
    rates = [
        Rate(
            kind,
            "#ff8000" * (1 + (kind == "two_tone")),
            1,
            Interval(share, share - 0.1, share + 0.1),
        )
        for kind, share in hidden.items()
    ]
    return PrecheckRecord("a", "", 0.5, MeasuredOn(8, "", (), 1, 0), [], rates)


def attack(name="T-U", detector="a", **given):
    strongest = beside("R-U_search", 0.1, SEARCHED)
    return made_row(name, detector, easr=EASR, **({"strongest": strongest} | given))


def test_a_paint_that_hides_more_is_the_strongest_control():
    row = beside_paints(attack(), {"a": record(paint_whole=0.3, paint_body=0.2)}, ["a"]).strongest
    assert str(row.control) == "plain paint RGB (255, 128, 0) on the whole vehicle"
    assert (row.easr, row.draws) == (0.3, 1)
    margin = math.hypot(0.1, 0.1)
    assert (row.net.estimate, row.net.low, row.net.high) == pytest.approx(
        (0.2, 0.2 - margin, 0.2 + margin)
    )


def test_every_paint_lowers_the_limit_though_another_control_hides_more():
    row = beside_paints(attack(), {"a": record(two_tone=0.09)}, ["a"]).strongest
    assert str(row.control) == "R-U_search"
    assert row.net.low == pytest.approx(0.41 - math.hypot(0.1, 0.1))
    assert row.net.high == 0.5


def test_a_masked_texture_has_paints_on_body_panels_alone():
    checked = {"a": record(paint_whole=0.3, paint_body=0.2)}
    row = beside_paints(attack("T-PixMa"), checked, ["a"]).strongest
    assert str(row.control) == "plain paint RGB (255, 128, 0) on body panels"


def test_the_mean_takes_a_paint_that_every_detector_saw():
    checked = {"a": record(paint_whole=0.9), "b": record(paint_whole=0.1, paint_body=0.8)}
    mean = attack(detector=MEAN)
    row = beside_paints(mean, checked, ["a", "b"]).strongest
    assert (str(row.control)[-13:], row.easr) == ("whole vehicle", 0.5)
    assert beside_paints(mean, checked, ["a", "b", "c"]) is mean


@pytest.mark.parametrize(
    "row",
    [
        attack("S-O@0.2"),
        attack(strongest=None),
        attack(match="centre_in_box"),
        attack(renderer="cycles"),
    ],
)
def test_other_rows_stay(row):
    assert beside_paints(row, {"a": record(paint_whole=0.3)}, ["a"]) is row


def test_other_changes_are_no_paints():
    row = beside_paints(attack(), {"a": record(blur=0.9)}, ["a"])
    assert str(row.strongest.control) == "R-U_search"
