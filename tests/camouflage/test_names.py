"""Names of repeats, variants and controls."""

import pytest

from skyproof.camouflage.names import is_control, matched_control, pooled_name


@pytest.mark.parametrize(
    ("name", "pooled"),
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
def test_pooled_name(name, pooled):
    assert pooled_name(name) == pooled


@pytest.mark.parametrize(
    ("name", "control"),
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
    ],
)
def test_matched_control(name, control):
    assert matched_control(name) == control
    assert is_control(control)
    assert not is_control(name)
