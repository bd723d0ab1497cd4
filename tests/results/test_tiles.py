"""Counts per tile, of outcomes and merged."""

import dataclasses
from typing import get_type_hints

import numpy as np
import pytest

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.results.outcomes import Outcome, OutcomeCounts, Series, read_counts, write_outcomes
from skyproof.results.rows_file import read_rows, write_rows
from skyproof.results.score_folder import (
    ScoreFolder,
    ScoreRecord,
    SetScore,
    merge_scores,
    write_record,
)
from tests.results.counted import count_outcomes, on_tiles, write_counts


def outcome(tile, camouflage, before, after, vehicle="car-1", detector="yolov5"):
    blank = {
        name: {str: "x", int: 0, bool: False, float: 0.0}[kind]
        for name, kind in get_type_hints(Outcome).items()
    }
    blank |= {
        "background": tile,
        "vehicle": vehicle,
        "camouflage": camouflage,
        "renderer": "torch",
        "detector": detector,
    }
    return Outcome(
        **(blank | {"match": "iou_50", "detected_original": before, "detected_adversarial": after})
    )


@pytest.fixture
def outcomes():
    return [
        outcome("b", "T-U-1", True, False),
        outcome("a", "T-U-1", True, True),
        outcome("a", "T-U-1", True, False),
        outcome("a", "T-U-1", False, True, "car-2"),
        outcome("a", "T-U-1", False, False, "car-2"),
        outcome("b", "T-U-0", True, True),
    ]


@pytest.fixture
def tiles(outcomes):
    return count_outcomes(outcomes)


def merged(folders):
    return merge_scores([ScoreFolder.open(folder) for folder in folders])


def test_counts_by_hand(tiles):
    assert tiles.cells == (("a", "car-1"), ("a", "car-2"), ("b", "car-1"))
    assert list(tiles.series) == [
        Series(name, "torch", "yolov5", "iou_50") for name in ("T-U-1", "T-U-0")
    ]
    first, second = tiles.series.values()
    assert first.tolist() == [[2, 1, 1, 0], [2, 0, 0, 1], [1, 0, 1, 0]]
    assert second.tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [1, 1, 0, 0]]


def same(one, other):
    assert one.cells == other.cells
    assert list(one.series) == list(other.series)
    assert all(np.array_equal(one.series[key], other.series[key]) for key in one.series)


def test_counts_of_stored_outcomes_are_the_same(tmp_path, tiles, outcomes):
    write_outcomes(tmp_path / "outcomes.parquet", outcomes)
    same(read_counts(tmp_path / "outcomes.parquet"), tiles)
    write_outcomes(tmp_path / "none.parquet", [])
    none = read_counts(tmp_path / "none.parquet")
    assert (none.series, none.cells) == ({}, ())


def test_outcomes_for_given_counts_give_them(tmp_path, tiles):
    write_counts(tmp_path / "outcomes.parquet", tiles)
    same(read_counts(tmp_path / "outcomes.parquet"), tiles)


def test_set_scores_round_trip(tmp_path):
    written = [SetScore("original", "torch", "yolov5", "iou_50", 0.5, 3.0)]
    write_rows(
        tmp_path / "sets.json",
        [*written, dataclasses.replace(written[0], average_precision=float("nan"))],
    )
    first, second = read_rows(tmp_path / "sets.json", SetScore, "score again")
    assert first == written[0]
    assert second.average_precision != second.average_precision
    (tmp_path / "sets.json").write_text('{"rows": [{"camouflage": "x"}]}')
    with pytest.raises(StoredFileError, match=r"sets\.json, rows\[0\]: the field renderer is"):
        read_rows(tmp_path / "sets.json", SetScore, "score again")


@pytest.fixture
def make_folder(tmp_path):
    def make(name, counts, precision=0.9, renderer="torch"):
        """A score folder with tiles "a" and "b" of two vehicles: (both, lost, gained)."""
        folder = tmp_path / name
        folder.mkdir()
        series = {
            Series(camouflage, renderer, "yolov5", "iou_50"): np.array([[2, *row] for row in rows])
            for camouflage, rows in counts.items()
        }
        write_counts(folder / "outcomes.parquet", on_tiles("ab", series))
        scores = [SetScore("original", renderer, "yolov5", "iou_50", precision, 3.0)]
        scores += [
            SetScore(camouflage, renderer, "yolov5", "iou_50", 0.2, 3.0) for camouflage in counts
        ]
        write_rows(folder / "sets.json", scores)
        write_record(folder, ScoreRecord({"yolov5": 0.5}, renderer=renderer))
        return folder

    return make


def test_folders_are_merged(make_folder):
    one = make_folder("one", {"T-U-0": [[1, 1, 0], [0, 2, 0]], "R-U-0": [[2, 0, 0], [2, 0, 0]]})
    two = make_folder("two", {"T-U-1": [[0, 2, 0], [0, 2, 0]], "R-U-0": [[2, 0, 0], [2, 0, 0]]})
    tiles, sets = merged([one, two])
    assert [key.camouflage for key in tiles.series] == ["T-U-0", "R-U-0", "T-U-1"]
    assert tiles.series[Series("T-U-1", "torch", "yolov5", "iou_50")].tolist() == [
        [2, 0, 2, 0],
        [2, 0, 2, 0],
    ]
    assert [score.camouflage for score in sets] == ["original", "T-U-0", "R-U-0", "T-U-1"]


def test_two_renderers_are_merged(make_folder):
    one = make_folder("one", {"T-U-0": [[1, 1, 0], [0, 2, 0]]})
    # The same names, other results and another precision: no contradiction.
    other = make_folder(
        "cycles", {"T-U-0": [[2, 0, 0], [0, 1, 0]]}, precision=0.7, renderer="cycles"
    )
    tiles, sets = merged([one, other])
    assert tiles.cells == (("a", "car"), ("b", "car"))
    assert tiles.series[Series("T-U-0", "torch", "yolov5", "iou_50")].tolist() == [
        [2, 1, 1, 0],
        [2, 0, 2, 0],
    ]
    assert tiles.series[Series("T-U-0", "cycles", "yolov5", "iou_50")].tolist() == [
        [2, 2, 0, 0],
        [2, 0, 1, 0],
    ]
    precision = {(score.camouflage, score.renderer): score.average_precision for score in sets}
    assert precision == {
        ("original", "torch"): 0.9,
        ("T-U-0", "torch"): 0.2,
        ("original", "cycles"): 0.7,
        ("T-U-0", "cycles"): 0.2,
    }


def test_repeats_that_other_detectors_judged_are_refused(make_folder):
    one = make_folder("one", {"T-U-0": [[1, 1, 0], [0, 2, 0]]})
    two = make_folder("two", {"T-U-1": [[1, 1, 0], [0, 2, 0]]})
    tiles = read_counts(two / "outcomes.parquet")
    more = {key._replace(detector="retinanet"): counts for key, counts in tiles.series.items()}
    write_counts(two / "outcomes.parquet", OutcomeCounts(tiles.cells, {**tiles.series, **more}))
    with pytest.raises(
        ConfigurationError, match="T-U-0 scored with yolov5, and another repeat of it"
    ):
        merged([one, two])


def test_contradictions_are_refused(make_folder, tmp_path):
    one = make_folder("one", {"T-U-0": [[1, 1, 0], [0, 2, 0]]})
    with pytest.raises(ConfigurationError, match="different results for T-U-0 and yolov5"):
        merged([one, make_folder("two", {"T-U-0": [[2, 0, 0], [0, 2, 0]]})])
    with pytest.raises(
        ConfigurationError, match="different results for the images without camouflage and"
    ):
        merged([one, make_folder("three", {"T-U-1": [[1, 1, 0], [0, 2, 0]]}, precision=0.8)])
    other = make_folder("four", {"T-U-2": [[1, 1, 0], [0, 2, 0]]})
    fewer = {Series("T-U-2", "torch", "yolov5", "iou_50"): np.array([[1, 0, 1, 0], [2, 0, 2, 0]])}
    write_counts(other / "outcomes.parquet", on_tiles("ab", fewer))
    with pytest.raises(ConfigurationError, match="same vehicles on the same tiles"):
        merged([one, other])


def test_a_score_without_counts_is_passed_over(make_folder, tmp_path):
    one = make_folder("one", {"T-U-0": [[1, 1, 0], [0, 2, 0]]})
    checked = tmp_path / "checked"
    checked.mkdir()
    write_record(checked, ScoreRecord({"yolov5": 0.5}))
    tiles, sets = merged([checked, one])
    assert list(tiles.series) == [Series("T-U-0", "torch", "yolov5", "iou_50")]
    assert len(sets) == 2
