"""Which camouflages are rendered for a detector that is trained elsewhere."""

from types import SimpleNamespace

import pytest

from skyproof.camouflage.name import CamouflageName
from skyproof.hardening.images import _strongest
from skyproof.results.statistics.intervals import Interval


def results(rates, folders=None):
    """Rows of camouflages with their rates, by the renderer."""
    rows = [
        SimpleNamespace(
            camouflage=CamouflageName.read(name),
            renderer="torch",
            easr=Interval(rate, rate - 0.1, rate + 0.1),
        )
        for name, rate in rates.items()
    ]
    return SimpleNamespace(rows=rows, records=dict.fromkeys(folders or rates))


@pytest.mark.parametrize(
    ("rates", "wanted"),
    [
        # Two copies of one attack count once.
        ({"T-U": 0.9, "T-U_asked": 0.95, "T-Ma": 0.5}, ["T-U_asked", "T-Ma"]),
        ({"R-U_pattern": 0.4, "R-U": 0.6, "T-U": 0.5}, ["T-U", "R-U"]),
        # The attack's own texture is no control.
        ({"R-C-PixFc-seq@0.2": 0.9, "C-PixFc-seq@0.2": 0.8}, ["C-PixFc-seq@0.2"]),
        ({"T-U": 0.05, "R-U": -0.1}, []),
    ],
)
def test_the_strongest_attacks_and_the_strongest_control_are_taken(rates, wanted):
    assert _strongest(results(rates)) == wanted


def test_of_repeats_the_first_is_taken_and_what_has_no_folder_is_left_out():
    found = _strongest(results({"T-U": 0.9, "T-Ma": 0.8}, folders=["T-U-0", "T-U-1"]))
    assert found == ["T-U-0"]
