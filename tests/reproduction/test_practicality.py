"""The paper's table of practicality, sign by sign, against what the constraints give."""

import pytest

from skyproof.camouflage.name import TextureConstraints
from skyproof.reproduction.practicality import score_practicality

# From the paper's table S4: texture and shape sign of PC, DI and DO, then the total.
OWN = [
    ("T-U", "-0", "-0", "-0", -3),
    ("T-Ma", "-0", "-0", "+0", -1),
    ("T-Pix", "-0", "+0", "-0", -1),
    ("T-PixMa", "-0", "+0", "+0", 1),
    ("T-Lc", "-0", "-0", "-0", -3),
    ("T-Fc", "-0", "-0", "-0", -3),
    ("T-LcMa", "-0", "-0", "+0", -1),
    ("T-FcMa", "-0", "-0", "+0", -1),
    ("T-PixLc", "00", "+0", "-0", 0),
    ("T-PixFc", "+0", "+0", "-0", 1),
    ("T-PixLcMa", "00", "+0", "+0", 2),
    ("T-PixFcMa", "+0", "+0", "+0", 3),
    ("S-O", "0-", "0-", "0-", -3),
    ("C-Fc", "--", "--", "--", -6),
    ("C-PixFc", "+-", "+-", "--", -2),
]
VALUE = {"+": 1, "0": 0, "-": -1}


def signs_of(*symbols):
    return [[VALUE[pair[place]] for pair in symbols] for place in (0, 1)]


@pytest.mark.parametrize(("name", "cost", "installation", "operation", "total"), OWN)
def test_own_camouflages(name, cost, installation, operation, total):
    kind, _, constraints = name.partition("-")
    texture = None if kind == "S" else TextureConstraints.parse(constraints)
    score = score_practicality(texture, shape_changed=kind in ("S", "C"))
    signs = [list(score[side].values()) for side in ("texture", "shape")]
    assert signs == signs_of(cost, installation, operation)
    assert score["total"] == total


def test_no_camouflage_costs_nothing():
    score = score_practicality(None, shape_changed=False)
    assert score["total"] == 0
    assert not any((*score["texture"].values(), *score["shape"].values()))
