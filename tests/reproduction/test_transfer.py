"""The matrix of attacked-on by evaluated-on."""

import math

import pytest

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.reproduction import transfer
from skyproof.results.statistics.intervals import Interval
from tests.results.rows import beside, made_row

read = CamouflageName.read


def row(camouflage, detector, easr, match="centre_1m"):
    net = Interval(easr - 0.2, math.nan, math.nan)
    rate = Interval(easr, easr - 0.1, easr + 0.1)
    return made_row(camouflage, detector, easr=rate, random=beside("R-U", 0.2, net), match=match)


ROWS = [
    row("T-U", "a", 0.9),
    row("T-U", "b", 0.8),
    row("T-U", "mean", 0.85),
    row("T-U_on_a", "a", 0.95),
    row("T-U_on_a", "b", 0.3),
    row("T-U_without_a", "a", 0.4),
    row("T-U_without_a", "b", 0.9),
    row("R-U", "a", 0.1),
    row("T-Pix", "a", 0.1),
    row("T-U", "a", 0.5, match="iou_50"),
]
ATTACKED = {
    "T-U-0": ["b", "a"],
    "T-U-1": ["a", "b"],
    "T-U_on_a-0": ["a"],
    "T-U_without_a-0": ["b"],
    "T-Pix": ["a"],
}


def transfer_matrix(rows, attacked, *, base):
    named = {read(name): detectors for name, detectors in attacked.items()}
    return transfer.transfer_matrix(rows, named, base=read(base))


def test_matrix_by_hand():
    matrix = transfer_matrix(ROWS, ATTACKED, base="T-U")
    assert [[cell.detector for cell in line] for line in matrix] == [["a", "b"]] * 3
    assert [str(line[0].camouflage) for line in matrix] == ["T-U_on_a", "T-U_without_a", "T-U"]
    assert [line[0].attacked for line in matrix] == [("a",), ("b",), ("a", "b")]
    assert [[cell.easr.estimate for cell in line] for line in matrix] == [
        [0.95, 0.3],
        [0.4, 0.9],
        [0.9, 0.8],
    ]
    easr = matrix[0][1].easr
    assert (easr.estimate, easr.low, easr.high) == pytest.approx((0.3, 0.2, 0.4))


def test_gaps_are_refused():
    with pytest.raises(ConfigurationError, match="no row of S-O"):
        transfer_matrix(ROWS, ATTACKED, base="S-O")
    with pytest.raises(ConfigurationError, match="not known which detectors T-U_on_a attacked"):
        transfer_matrix(ROWS, {"T-U": ["a", "b"]}, base="T-U")
    with pytest.raises(ConfigurationError, match="b has not judged T-U_on_a"):
        transfer_matrix(
            [r for r in ROWS if str(r.camouflage) != "T-U_on_a" or r.detector == "a"],
            ATTACKED,
            base="T-U",
        )
    with pytest.raises(ConfigurationError, match="Repeats of T-U attacked different detectors"):
        transfer_matrix(ROWS, ATTACKED | {"T-U-2": ["a"]}, base="T-U")
