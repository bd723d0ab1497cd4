"""The matrix of attacked-on by evaluated-on."""

import pytest

from skyproof.errors import ConfigurationError
from skyproof.paper.transfer import transfer_matrix


def row(camouflage, detector, easr, **changes):
    values = {f"{key}{end}": None for key in ("easr", "net_easr") for end in ("", "_low", "_high")}
    values |= {
        "camouflage": camouflage,
        "detector": detector,
        "renderer": "torch",
        "match": "centre_1m",
    }
    return (
        values
        | {"easr": easr, "easr_low": easr - 0.1, "easr_high": easr + 0.1, "net_easr": easr - 0.2}
        | changes
    )


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


def test_matrix_by_hand():
    matrix = transfer_matrix(ROWS, ATTACKED, base="T-U")
    assert [[cell.detector for cell in line] for line in matrix] == [["a", "b"]] * 3
    assert [line[0].camouflage for line in matrix] == ["T-U_on_a", "T-U_without_a", "T-U"]
    assert [line[0].attacked for line in matrix] == [("a",), ("b",), ("a", "b")]
    assert [[cell.white_box for cell in line] for line in matrix] == [
        [True, False],
        [False, True],
        [True, True],
    ]
    assert [[cell.easr[0] for cell in line] for line in matrix] == [
        [0.95, 0.3],
        [0.4, 0.9],
        [0.9, 0.8],
    ]
    assert matrix[0][1].easr == pytest.approx((0.3, 0.2, 0.4))
    assert matrix[0][1].net_easr == (pytest.approx(0.1), None, None)


def test_gaps_are_refused():
    with pytest.raises(ConfigurationError, match="no row of S-O"):
        transfer_matrix(ROWS, ATTACKED, base="S-O")
    with pytest.raises(ConfigurationError, match="not known which detectors T-U_on_a attacked"):
        transfer_matrix(ROWS, {"T-U": ["a", "b"]}, base="T-U")
    with pytest.raises(ConfigurationError, match="b has not judged T-U_on_a"):
        transfer_matrix(
            [r for r in ROWS if r["camouflage"] != "T-U_on_a" or r["detector"] == "a"],
            ATTACKED,
            base="T-U",
        )
    with pytest.raises(ConfigurationError, match="Repeats of T-U attacked different detectors"):
        transfer_matrix(ROWS, ATTACKED | {"T-U-2": ["a"]}, base="T-U")
