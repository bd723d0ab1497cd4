"""Figures of the report show whatever a camouflage is called, and every interval whole."""

import pytest

from skyproof.report.figures import forest_figure
from skyproof.results.statistics.intervals import Interval
from tests.results.rows import beside, made_row


def drawn(name, high=0.95):
    net = Interval(0.9, 0.8, high)
    row = made_row(
        name,
        "mean",
        easr=Interval(0.9, 0.85, 0.95),
        random=beside("R-mine", 0.0, net),
        match="centre_1m",
    )
    return forest_figure("salt", [name], [row], [None])


def test_a_name_is_no_formula():
    assert drawn("mine_$a$x^$b").startswith("<svg")


@pytest.mark.parametrize("high", [0.99, 1.3])
def test_limits_beyond_all_are_seen(high, monkeypatch):
    monkeypatch.setattr("skyproof.report.figures.as_svg", lambda figure: figure.axes[0].get_xlim())
    assert drawn("mine", high)[1] > 100 * max(high, 1)
