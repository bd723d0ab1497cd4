"""What tools/fleet_answers.py says of counts whose answer is known."""

import numpy as np
import pytest
from fleet_answers import FleetAnswers, compared

from skyproof.results.pairs.tiles import Series, TileCounts, write_tiles


def tiles_of(shares, seed, vehicle="saloon"):
    """Thirty tiles with ten vehicles each; of every camouflage a share is hidden, by chance."""
    draws = np.random.default_rng(seed)
    cells = tuple((f"t{tile:02d}", f"{vehicle}-{tile % 8:04d}") for tile in range(30))
    series = {}
    for name, share in shares.items():
        for detector in ("retinanet", "faster_rcnn"):
            lost = draws.binomial(10, share, 30)
            counts = np.stack([np.full(30, 10), 10 - lost, lost, np.zeros(30, int)], axis=1)
            series[Series(name, "torch", detector, "centre_1m")] = counts
            # The other rule would say something else.
            series[Series(name, "torch", detector, "iou_50")] = counts[:, [0, 2, 1, 3]]
    return TileCounts(cells, series)


def test_a_difference_is_found_where_there_is_one():
    drawn = tiles_of({"T-U-0": 0.8, "T-U-1": 0.8, "T-Ma-0": 0.6, "R-U_plain": 0.1}, 0)
    learnt = tiles_of({"T-U-0": 0.4, "T-U-1": 0.4, "T-Ma-0": 0.6, "R-U_plain": 0.1}, 1)
    record = compared(drawn, learnt)
    assert list(record) == ["T-U", "T-Ma", "R-U_plain"]
    assert record["T-U"]["drawn"][0] == pytest.approx(0.8, abs=0.05)
    estimate, low, high = record["T-U"]["more_on_learnt"]
    assert estimate == pytest.approx(-0.4, abs=0.06)
    assert low < estimate < high < 0
    for name in ("T-Ma", "R-U_plain"):
        _, low, high = record[name]["more_on_learnt"]
        assert low < 0 < high
    # One start of an attack says less than what was chosen among many and stays as it is.
    widths = {name: row["more_on_learnt"][2] - row["more_on_learnt"][1]
              for name, row in record.items()}  # fmt: skip
    assert widths["R-U_plain"] < widths["T-Ma"]


def test_the_tool_reads_score_folders(tmp_path):
    for name, share in (("drawn", 0.8), ("learnt", 0.7)):
        (tmp_path / name).mkdir()
        write_tiles(tmp_path / name / "tiles.parquet", tiles_of({"T-U-0": share}, 0, name))
    tool = FleetAnswers(tmp_path / "drawn", tmp_path / "learnt", tmp_path / "out.json")
    assert tool.run()["T-U"]["learnt"][0] == pytest.approx(0.7, abs=0.05)
    assert (tmp_path / "out.json").exists()
