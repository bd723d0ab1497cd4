"""EASR by detectors attacked and detector."""

import math

import pytest

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.reproduction.transfer import transfer_rows
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


def transfer(rows, attacked, *, base):
    named = {read(name): detectors for name, detectors in attacked.items()}
    return transfer_rows(rows, named, read(base))


def test_rows_by_hand():
    found = transfer(ROWS, ATTACKED, base="T-U")
    assert [row["attacked_on"] for row in found] == ["a", "b", "a b"]
    assert {row["attack"] for row in found} == {"T-U"}
    easr = [[round(row[judge]) for judge in ("a", "b")] for row in found]
    assert easr == [[95, 30], [40, 90], [90, 80]]
    limits = [found[0][key] for key in ("b", "b_low", "b_high")]
    assert limits == pytest.approx([30, 20, 40])


def test_gaps_are_refused():
    assert transfer(ROWS, ATTACKED, base="S-O") == []
    with pytest.raises(ConfigurationError, match="not known which detectors T-U_on_a attacked"):
        transfer(ROWS, {"T-U": ["a", "b"]}, base="T-U")
    with pytest.raises(ConfigurationError, match="b has not scored T-U_on_a"):
        transfer(
            [r for r in ROWS if str(r.camouflage) != "T-U_on_a" or r.detector == "a"],
            ATTACKED,
            base="T-U",
        )
    with pytest.raises(ConfigurationError, match="Repeats of T-U attacked different detectors"):
        transfer(ROWS, ATTACKED | {"T-U-2": ["a"]}, base="T-U")
