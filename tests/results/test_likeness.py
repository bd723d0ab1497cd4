"""Bounds of the comparison of rendered and photographed vehicles, and its words."""

from dataclasses import replace

import pytest

from skyproof.results.likeness import Likeness, Look
from skyproof.results.statistics.intervals import UNDEFINED, Interval

LOOK = Look(26.0, 188.0, 0.013, 18.0, 4.5)


def sure(estimate, margin=0.05):
    return Interval(estimate, estimate - margin, estimate + margin)


def likeness(difference=0.02, higher=0.5, *, margin=0.05, **given):
    rendered = sure(0.7 - difference)
    values = {
        "detector": "retinanet", "dataset": "your imagery", "match": "centre_1m", "tiles": 12,
        "photographed": 40, "rendered": 90, "recall_photographed": sure(0.7),
        "recall_rendered": rendered, "recall_difference": sure(difference, margin),
        "median_photographed": 0.74, "median_rendered": 0.71, "higher": sure(higher, margin),
        "photographs": LOOK, "renders": LOOK,
    }  # fmt: skip
    return Likeness(**{**values, **given})


@pytest.mark.parametrize(
    ("difference", "higher", "state"),
    [
        (0.0, 0.5, "alike"),
        (0.09, 0.69, "alike"),
        (-0.09, 0.31, "alike"),
        (0.11, 0.5, "borderline"),
        (-0.14, 0.5, "borderline"),
        (0.0, 0.74, "borderline"),
        (0.16, 0.5, "not alike"),
        (-0.16, 0.5, "not alike"),
        (0.0, 0.76, "not alike"),
        (0.0, 0.24, "not alike"),
    ],
)
def test_renders_are_not_valid_if_a_whole_interval_lies_out_of_bounds(difference, higher, state):
    assert likeness(difference, higher).state == state


@pytest.mark.parametrize(
    "few", [{"photographed": 19}, {"rendered": 19}, {"tiles": 4}, {"higher": UNDEFINED}]
)
def test_few_vehicles_or_tiles_say_nothing(few):
    row = replace(likeness(0.4, 0.9), **few)
    assert row.state == "unknown"
    assert row.sentence.startswith("It cannot be said whether RetinaNet sees rendered vehicles")


def test_the_sentence_has_the_numbers_of_both_kinds():
    assert likeness().sentence.replace("\u202f", " ") == (
        "RetinaNet scores rendered vehicles like photographed ones: it finds 68 % (63 to 73 %) of "
        "90 and 70 % (65 to 75 %) of 40 on the same 12 tiles of your imagery, with median scores "
        "of 0.71 and 0.74. In 50 % (45 to 55 %) of pairs the photographed vehicle scores higher."
    )


def test_what_differs_is_told_where_both_kinds_are_not_seen_alike():
    bright = Look(57.0, 243.0, 0.106, 10.0, 3.9)
    said = likeness(0.3, renders=bright).sentence.replace("\u202f", " ")
    assert "RetinaNet does not score rendered vehicles like photographed ones" in said
    assert said.endswith(
        "Rendered vehicles have brighter darkest parts (2nd percentile of luminance 57 against "
        "26), have brighter brightest parts (98th percentile of luminance 243 against 188), hold "
        "more pure white (10.6 % against 1.3 %), are less colourful (chroma 10 against 18) and are "
        "shorter (3.9 against 4.5 m)."
    )
    assert "Rendered vehicles have" not in likeness(renders=bright).sentence
    assert likeness(0.3).sentence.endswith("of the vehicles do not tell why.")
    assert len(likeness().differences) == 5


def test_what_lies_within_its_bounds_differs_in_nothing():
    near = Look(35.0, 197.0, 0.022, 20.5, 4.9)
    assert not any(each.clause for each in likeness(renders=near).differences)
    # Shares of white below a point are noise.
    dark = replace(LOOK, white_share=0.0)
    hardly = replace(LOOK, white_share=0.009)
    assert not any(each.clause for each in likeness(photographs=dark, renders=hardly).differences)
