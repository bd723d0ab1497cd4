"""The command that says how large a test must be."""

import numpy as np
import pytest

from skyproof.results.pairs.tiles import Series
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.statistics.compliance import tiles_to_decide
from skyproof.results.statistics.planning import Assumptions, vehicles_needed
from tests.cli.conftest import Skyproof, flags
from tests.results.counted import on_tiles, write_counts


def test_the_answer_and_the_table(skyproof: Skyproof):
    said = skyproof("sample-size", "--half-width", 0.05, "--easr", 0.8)
    assert said.code == 0
    # Nine vehicles a tile at a correlation of 0.1.
    need = vehicles_needed(0.05, Assumptions(0.8, design_effect=1.8))
    assert f"About {need.vehicles} test vehicles on {need.tiles} background tiles" in said.out
    table = [line.split() for line in said.out.splitlines() if line.startswith("  ")][1:]
    assert [line[0] for line in table] == ["±10", "±5", "±2.5", "±1.25"]
    assert int(table[1][-2].replace(",", "")) == need.vehicles
    # 32 vehicles alone leave ±3.3 points.
    assert [line[-2:] for line in table[2:]] == [["–", "–"]] * 2
    assert "tiles 58 %, vehicles 42 %: more tiles narrow it most." in said.out
    assert (
        "It says nothing of other seeds of the attack or other trainings of the detector."
        in said.out
    )


def test_seeds_and_draws_are_planned_for(skyproof: Skyproof):
    said = skyproof("sample-size", *flags("--half-width 0.15 --seeds 5 --draws 20"))
    assert "says nothing of other trainings of the detector." in said.out
    assert "interval of the net of an EASR of 80 % is about ±15" in said.out
    assert "draws 50 %, tiles 35 %, seeds 10 %, vehicles 5 %: more draws narrow it" in said.out
    assert "5 seeds of standard deviation 0.03; 20 draws of standard deviation 0.20" in said.out
    trained = skyproof("sample-size", *flags("--half-width 0.25 --draws 20 --trainings 3"))
    assert "says nothing" not in trained.out
    assert "trainings 54 %, tiles 26 %, draws 18 %, vehicles 2 %: more trainings" in trained.out
    assert "20 draws of standard deviation 0.20; 3 trainings of standard deviation 0.10" in (
        trained.out
    )
    one = skyproof("sample-size", *flags("--half-width 0.15 --draws 1 --fleet 1"))
    assert (
        "nothing of other vehicles or other seeds of the attack or other draws of the control or"
        in one.out
    )


def test_a_requirement_asks_for_a_test_that_decides(skyproof: Skyproof):
    said = skyproof("sample-size", *flags("--accept 0.2 --reject 0.3"))
    assert said.code == 0
    tiles = tiles_to_decide(Requirement(0.2, 0.3), Assumptions(0.8, design_effect=1.8))
    assert f"About {9 * tiles} test vehicles on {tiles} background tiles" in said.out
    assert (
        "accept a detector that loses 20 % of its found vehicles, and reject one that" in said.out
    )
    stricter = skyproof("sample-size", *flags("--accept 0.2 --reject 0.3 --consumer-risk 0.01"))
    assert "at most 5 and 1 % err" in stricter.out


def test_a_pilot_gives_what_is_not_given(skyproof: Skyproof, tmp_path):
    lost = np.tile([1, 2, 3, 4], 10)
    counts = np.stack([np.full(40, 5), 4 - lost, lost, np.zeros(40, dtype=np.int64)], axis=1)
    series = {Series("T-U", "torch", "a", "centre_1m"): counts}
    tiles = on_tiles([f"t{i:02d}" for i in range(40)], series)
    write_counts(tmp_path / "outcomes.parquet", tiles)
    said = skyproof("sample-size", "--pilot", tmp_path)
    assert "of an EASR of 62 %" in said.out
    assert "as T-U before a in the pilot: 5 vehicles a tile, 80 % of them found before" in said.out
    assert (
        "5 vehicles a tile"
        not in skyproof("sample-size", "--pilot", tmp_path, "--vehicles-per-tile", 2).out
    )


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("--half-width 0", "half-width"),
        ("--half-width 1", "half-width"),
        ("--half-width nan", "half-width"),
        ("--half-width -0.1", "half-width"),
        ("--easr 1.2", "--easr expects a number from -1 up to 1, got 1.2"),
        ("--easr -0.2", "EASR"),
        ("--easr nan", "--easr"),
        ("--easr 0.9 --enhancement-rate 0.2", "EASR"),
        ("--vehicles-per-tile 0", "--vehicles-per-tile expects a number above 0"),
        ("--intra-tile-correlation 1.5", "intra-tile-correlation"),
        ("--intra-vehicle-correlation 2", "intra-vehicle-correlation"),
        ("--fleet 0", "--fleet"),
        ("--seeds 3 --half-width 0.01", "with so few seeds at best"),
        ("--pilot nowhere", "outcomes.parquet is missing"),
        ("--accept 0.2", "expects two shares, --accept and --reject, got only one"),
        ("--accept 0.3 --reject 0.2", "exchange them"),
        ("--accept 0.2 --reject 0.201", "set the two shares farther apart"),
        ("--accept 0.2 --reject 0.3 --producer-risk 0.6", "--producer-risk"),
    ],
)
def test_bad_input_is_refused(skyproof: Skyproof, arguments, word):
    skyproof("sample-size", *flags(arguments)).refused(word)
