"""Success by condition: which panels there are, and how vehicles are divided among them."""

from typing import get_type_hints

import numpy as np
import pytest

from skyproof.results.conditions import condition_panels
from skyproof.results.outcomes import Outcome


def outcomes(conditions):
    """One vehicle per condition and tile, found before; those in haze are lost."""
    blank = {
        name: {str: "x", int: 0, bool: True, float: 30.0}[kind]
        for name, kind in get_type_hints(Outcome).items()
    }
    return [
        Outcome(
            **blank
            | {
                "scene": f"s{index}",
                "background": f"tile-{index}",
                "body_type": "van",
                "condition": condition,
                "detected_adversarial": condition != "haze",
            }
        )
        for index, condition in enumerate(conditions)
    ]


def panels(conditions):
    drawn = condition_panels(outcomes(conditions), generator=np.random.default_rng(0))
    return {panel.title: panel for panel in drawn}


def test_weather_has_a_panel_where_scenes_differ_in_it():
    panel = panels(["clear", "haze", "low_sun", "haze", "clear", "clear"])["Weather and light"]
    assert [(bar.label, bar.vehicles) for bar in panel.bins] == [
        ("clear", 3),
        ("haze", 2),
        ("low\nsun", 1),
    ]
    assert [bar.rate.estimate for bar in panel.bins] == [0.0, 1.0, 0.0]
    assert panel.overall == pytest.approx(2 / 6)


@pytest.mark.parametrize("condition", ["clear", "haze"])
def test_weather_has_none_where_all_scenes_have_the_same(condition):
    drawn = panels([condition] * 4)
    assert "Weather and light" not in drawn
    assert len(drawn) == 4


def test_values_that_are_all_alike_make_one_bin():
    # Every vehicle of these is 30 degrees off, and the sun as high.
    for title in ("Sun above the horizon", "Camera off the vertical"):
        (alone,) = panels(["clear"] * 4)[title].bins
        assert (alone.label, alone.vehicles) == ("30°", 4)
