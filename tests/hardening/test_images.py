"""Which camouflages are rendered for a detector that is trained elsewhere."""

import shutil

import pytest

from skyproof.errors import ConfigurationError
from skyproof.hardening.images import strongest
from skyproof.results.results import Results
from tests.report.fabricate import DETECTORS, HIDES, fabricate
from tests.report.test_hardening import with_world


@pytest.fixture
def run_folder(tmp_path, monkeypatch):
    """A fabricated run of a single detector with its world."""
    monkeypatch.setattr("tests.report.fabricate.DETECTORS", DETECTORS[:1])
    more = {
        "T-U_asked1500": 0.95,
        "T-U_transfer": 0.65,
        "T-Ma-0": 0.6,
        "T-Ma-1": 0.6,
        "S-O@0.2": 0.3,
    }
    more |= {"R-U_pattern": 0.6, "R-U_plain": 0.3}
    for name, rate in more.items():
        monkeypatch.setitem(HIDES, name, rate)
    folder = with_world(fabricate(tmp_path / "run", scenes=16))
    for name in more:
        shutil.copytree(folder / "camouflages/T-U", folder / "camouflages" / name)
    return folder


def test_two_kinds_of_attacks_and_the_strongest_control_are_taken_by_their_folders(run_folder):
    assert strongest(Results.open(run_folder)) == ["T-U", "T-Ma-0", "R-U_pattern"]


def test_where_nothing_surely_hides_that_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(HIDES, "T-U", 0.0)
    folder = with_world(fabricate(tmp_path / "run", scenes=16))
    with pytest.raises(ConfigurationError, match=r"No attack in .* surely hides anything"):
        strongest(Results.open(folder))
