"""Names of camouflages as values: what they say, and that they come back as they went in."""

import pytest

from skyproof.camouflage.name import CamouflageName, TextureConstraints
from skyproof.errors import ConfigurationError

FIXED = TextureConstraints(colours="fixed")
KNOWN = [
    ("T-U", "texture", TextureConstraints(), None, None, False),
    ("T-PixFcMa-2", "texture", TextureConstraints(True, "fixed", True), None, None, False),
    ("T-U_on_faster_rcnn-0", "texture", TextureConstraints(), None, None, False),
    ("T-Fc_step10", "texture", FIXED, None, None, False),
    ("R-Pix-1", "texture", TextureConstraints(True), None, None, True),
    ("S-O@0.4", "shape", None, 0.4, None, False),
    ("S-O@1-1", "shape", None, 1.0, None, False),
    ("R-S-O@0.2-0", "shape", None, 0.2, None, True),
    ("C-Fc-seq@0.2-1", "combination", FIXED, 0.2, "seq", False),
    (
        "C-PixLcMa-par@1",
        "combination",
        TextureConstraints(True, "learnt", True),
        1.0,
        "par",
        False,
    ),
    ("R-C-Fc@0.2", "combination", FIXED, 0.2, None, True),
    ("R-C-Fc-seq@0.2-3", "combination", FIXED, 0.2, "seq", True),
    ("R-S-O@0.4_plain", "shape", None, 0.4, None, True),
]


@pytest.mark.parametrize(("text", "kind", "constraints", "magnitude", "order", "random"), KNOWN)
def test_names_are_read_and_come_back(text, kind, constraints, magnitude, order, random):
    name = CamouflageName.parse(text)
    assert (name.kind, name.constraints, name.magnitude) == (kind, constraints, magnitude)
    assert (name.order, name.random) == (order, random)
    assert str(name) == text
    assert CamouflageName.read(text) == name


def test_a_magnitude_has_one_way_to_be_written():
    assert str(CamouflageName.parse("S-O@1.0-1")) == "S-O@1-1"
    assert str(CamouflageName.parse("C-Fc-seq@0.20")) == "C-Fc-seq@0.2"


@pytest.mark.parametrize(
    "text",
    [
        "mine",
        "mine-2",
        "FCA_repainted-0",
        "none",
        "",
        "T-U_",
        "T-MaPix-1",
        "S-O",
        "R-mine",
        "S-O@2",
    ],
)
def test_foreign_names_come_back_too(text):
    name = CamouflageName.read(text)
    assert name.kind == "other"
    assert str(name) == text


@pytest.mark.parametrize(
    ("text", "label", "variant", "repeat"),
    [
        # A user's words are no variants, or the camouflage would be missing beside the learnt ones.
        ("winter_white-2", "winter_white", "", "2"),
        ("FCA_repainted", "FCA_repainted", "", ""),
        ("mine_on_retinanet-2", "mine_on_retinanet", "", "2"),
        ("winter_best", "winter_best", "", ""),
        ("winter_white_step10-2", "winter_white", "step10", "2"),
        ("winter_white_asked1500", "winter_white", "asked1500", ""),
        ("R-winter_white_best", "R-winter_white", "best", ""),
        ("R-winter_white-3", "R-winter_white", "", "3"),
    ],
)
def test_a_foreign_name_has_only_the_variants_that_skyproof_adds(text, label, variant, repeat):
    name = CamouflageName.read(text)
    assert (name.label, name.variant, name.repeat) == (label, variant, repeat)
    assert str(name) == text
    assert str(name.base) == label
    assert name.kept_copy == (variant not in ("", "best"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("T-LcFc", "exclude each other"),
        ("T-MaPix", "'PixMa'"),
        ("T-Blue", "Unknown texture constraints"),
        ("S-O@1.5", "from 0 to 1"),
        ("S-O@-0.1", "from 0 to 1"),
        ("C-Fc-seq@nan", "from 0 to 1"),
        ("S-O@much", "from 0 to 1.*'much'"),
        ("S-O", "names no camouflage"),
        ("C-Fc@0.2", "names no camouflage"),
        ("C-Fc-both@0.2", "names no camouflage"),
        ("U", "names no camouflage"),
        ("", "names no camouflage"),
        ("T-U_../../x", "names no camouflage"),
        ("T-U_a/b-1", "names no camouflage"),
        ("T-U_a\0b", "names no camouflage"),
        ("T-U_a\\b", "names no camouflage"),
        ("T-U_" + "a" * 200, "at most 150 characters"),
    ],
)
def test_names_that_contradict_themselves_are_refused(text, said):
    with pytest.raises(ConfigurationError, match=said):
        CamouflageName.parse(text)


@pytest.mark.parametrize(
    ("text", "pooled"),
    [
        ("T-U", "T-U"),
        ("T-U-1", "T-U"),
        ("R-PixFc-0", "R-PixFc"),
        ("R-PixMa-12", "R-PixMa"),
        ("S-O@0.4", "S-O@0.4"),
        ("S-O@0.4-1", "S-O@0.4"),
        ("C-Fc-seq@0.2", "C-Fc-seq@0.2"),
        ("C-Fc-seq@0.2-2", "C-Fc-seq@0.2"),
        ("T-U_on_faster_rcnn-0", "T-U_on_faster_rcnn"),
    ],
)
def test_repeats_are_pooled(text, pooled):
    assert str(CamouflageName.read(text).pooled) == pooled


@pytest.mark.parametrize(
    ("text", "control"),
    [
        ("T-PixMa", "R-PixMa"),
        ("T-PixMa-2", "R-PixMa"),
        ("S-O@0.4", "R-S-O@0.4"),
        ("C-Fc-seq@0.2", "R-C-Fc@0.2"),
        ("C-Fc-par@0.2", "R-C-Fc@0.2"),
        ("C-PixFcMa-seq@0.2-1", "R-C-PixFcMa@0.2"),
        ("T-U_on_retinanet", "R-U"),
        ("T-U_without_faster_rcnn-0", "R-U"),
        ("S-O@0.4_step10-0", "R-S-O@0.4"),
        ("T-mine-3", "R-mine"),
    ],
)
def test_everything_learnt_has_a_random_control(text, control):
    name = CamouflageName.read(text)
    assert str(name.control) == control
    assert name.control.random
    assert not name.random


def test_variants_and_repeats_are_added_in_their_places():
    name = CamouflageName.parse("T-U-0")
    assert str(name.with_variant("step10")) == "T-U_step10-0"
    assert (
        str(name.with_variant("on_retinanet").with_variant("step1")) == "T-U_on_retinanet_step1-0"
    )
    assert str(name.with_repeat(3)) == "T-U-3"
    assert CamouflageName.parse("C-Fc-par@0.2-1").family == "C-Fc-par"


@pytest.mark.parametrize(
    ("learnt", "expected"),
    [
        ("T-U", ["R-U_plain", "R-U_best", "R-U_search", "R-U_pattern"]),
        (
            "T-PixFcMa_on_yolov5-2",
            ["R-Ma_plain", "R-PixFcMa_best", "R-PixFcMa_search", "R-Ma_pattern"],
        ),
        ("S-O@0.4-1", ["R-S-O@0.4_plain", "R-S-O@0.4_best", "R-S-O@0.4_search"]),
        (
            "C-Lc-par@0.2",
            ["R-C-U@0.2_plain", "R-C-Lc@0.2_best", "R-C-Lc@0.2_search", "R-U_pattern"],
        ),
    ],
)
def test_every_attack_has_chosen_controls(learnt, expected):
    name = CamouflageName.parse(learnt)
    assert [str(control) for control in name.chosen_controls] == expected
    assert all(CamouflageName.parse(text).choice for text in expected)


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("T-U", "T-U_asked1500"),
        ("T-U_asked", "T-U_asked1500"),
        ("C-PixFc-seq@0.2", "C-PixFc-seq@0.2_asked1500"),
        ("R-U_search", "R-U_search_asked1500"),
    ],
)
def test_copies_of_a_search_say_after_how_many_images(name, kept):
    found = CamouflageName.parse(name).after_queries(1500)
    assert str(found) == kept
    # It is neither a random draw nor a chosen control.
    assert found.choice is None
    assert found.pooled != CamouflageName.parse(name).control


def test_a_combination_has_its_own_texture_under_random_shapes():
    assert str(CamouflageName.parse("C-Fc-par@0.2-1").random_shape) == "R-C-Fc-par@0.2"
    assert CamouflageName.parse("T-Fc").random_shape is None
    assert CamouflageName.parse("R-C-Fc-seq@0.2").random_shape is None
    with pytest.raises(ConfigurationError, match=r"give R-C-Fc@0.2_best"):
        CamouflageName.parse("R-C-Fc-seq@0.2_best")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("T-U", "free texture on the whole vehicle"),
        ("T-PixFcMa", "blocks in ground colours on painted panels"),
        ("T-PixLc-1", "blocks in a few optimised colours on the whole vehicle"),
        ("S-O@0.2", "changed shape (up to 20\u202f% of the width)"),
        (
            "C-PixFc-seq@0.2",
            "blocks in ground colours on the whole vehicle, with a changed shape "
            "(up to 20\u202f% of the width)",
        ),
        ("R-Ma_plain", "best plain paint on painted panels"),
        ("R-S-O@0.4_plain", "own paint, every vertex out up to 40\u202f% of the width"),
        (
            "R-PixFc_best",
            "best of many random draws: blocks in ground colours on the whole vehicle",
        ),
        ("R-Pix_search", "random search: texture in blocks on the whole vehicle"),
        ("R-U-3", "random: free texture on the whole vehicle"),
        ("T-U_transfer", "free texture on the whole vehicle, optimised on other detectors"),
        ("T-U_asked", "free texture on the whole vehicle, by a query attack"),
        ("winter_white", "winter_white"),
    ],
)
def test_a_camouflage_is_told_in_words(name, words):
    assert CamouflageName.read(name).in_words == words
