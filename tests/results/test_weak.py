"""Attacks that something within their own constraints beats are named."""

from types import SimpleNamespace

import pytest

from skyproof.camouflage.name import CamouflageName
from skyproof.results.statistics.intervals import Interval
from skyproof.results.weak import weak_attacks
from tests.results.rows import beside, made_row


def row(name, hidden, **given):
    return made_row(name, "a", easr=Interval(hidden, hidden - 0.1, hidden + 0.1), **given)


def weak(*rows):
    quoted = [each for each in rows if not each.camouflage.random and each.match == "centre_1m"]
    return weak_attacks(SimpleNamespace(rows=rows, quoted=quoted))


@pytest.mark.parametrize(
    ("one", "other", "meets"),
    [
        ("T-PixFcMa", "T-Ma", True),
        ("T-LcMa", "T-U", True),
        ("T-Fc", "T-Lc", True),
        ("S-O@0.2", "S-O@0.4", True),
        ("T-U", "C-U-seq@0.2", True),
        ("R-U_pattern", "T-U", True),
        ("R-U_pattern", "T-Ma", False),
        ("T-Fc", "C-PixFc-seq@0.2", False),
        ("S-O@0.2", "C-U-seq@0.4", False),
        ("T-Lc", "T-Fc", False),
        ("S-O@0.4", "S-O@0.2", False),
    ],
)
def test_constraints_are_compared(one, other, meets):
    assert CamouflageName.parse(one).meets(CamouflageName.parse(other)) is meets


@pytest.mark.parametrize("better", ["T-PixFcMa", "R-Ma_plain", "R-PixMa_search"])
def test_an_attack_that_its_own_subset_beats_is_named(better):
    (told,) = weak(row("T-Ma", 0.4), row(better, 0.5))
    assert told == f"T-Ma hides 40\u202f% and {better}, which it could have found, 50\u202f%"
    assert not weak(row("T-Ma", 0.6), row(better, 0.5))


def test_a_single_draw_can_beat_an_attack():
    net = Interval(-0.1, -0.2, 0.0)
    (told,) = weak(row("T-Ma", 0.4, strongest=beside("R-Ma-3", 0.5, net)))
    assert "R-Ma-3" in told
    # A paint has colours that blocks of ground colours have not.
    assert not weak(row("T-PixFc", 0.4, strongest=beside("plain paint red", 0.5, net)))


def test_only_what_was_measured_alike_counts():
    others = [
        row("T-FcMa", 0.9, renderer="cycles"),
        row("T-FcMa", 0.9, match="centre_in_box"),
        row("T-FcMa_step10", 0.9),
        row("mine", 0.9),
    ]
    assert not weak(row("T-Ma", 0.4), *others)
