"""Outcomes on disk."""

import math
from typing import get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from skyproof.errors import StoredFileError
from skyproof.results.outcomes import Outcome, read_outcomes, write_outcomes


def outcome(**changes):
    values = {
        name: {str: "x", int: 3, bool: True, float: 0.1}[kind]
        for name, kind in get_type_hints(Outcome).items()
    }
    return Outcome(**(values | {"match": "centre_1m"} | changes))


def test_round_trip(tmp_path):
    written = [
        outcome(),
        outcome(scene="y", detected_adversarial=False),
        outcome(distance_adversarial_m=math.nan),
    ]
    write_outcomes(tmp_path / "outcomes.parquet", written)
    read = read_outcomes(tmp_path / "outcomes.parquet")
    assert read[:2] == written[:2]
    assert math.isnan(read[2].distance_adversarial_m)
    assert [path.name for path in tmp_path.iterdir()] == ["outcomes.parquet"]


def test_empty_round_trip(tmp_path):
    write_outcomes(tmp_path / "o.parquet", [])
    assert read_outcomes(tmp_path / "o.parquet") == []


def test_bad_files_are_named(tmp_path):
    path = tmp_path / "outcomes.parquet"
    with pytest.raises(StoredFileError, match=r"outcomes\.parquet is missing"):
        read_outcomes(path)
    path.write_bytes(b"not parquet")
    with pytest.raises(StoredFileError, match="not a readable Parquet file"):
        read_outcomes(path)
    pq.write_table(pa.table({"scene": ["a"]}), path)
    with pytest.raises(StoredFileError, match="other columns"):
        read_outcomes(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"camouflage": "../../elsewhere"},
        {"detector": "a\0b"},
        {"scene": "x" * 100_000},
        {"match": "luck"},
        {"placement": -1},
        {"score_original": math.inf},
        {"distance_original_m": -1.0},
        {"distance_original_m": math.inf},
        {"tilt_deg": math.nan},
        {"visible_fraction": 1.5},
    ],
)
def test_a_table_of_values_that_cannot_be_is_refused(tmp_path, changes):
    path = tmp_path / "outcomes.parquet"
    write_outcomes(path, [outcome(), outcome(**changes)])
    with pytest.raises(
        StoredFileError, match=r"outcomes\.parquet .*; copy .* or score again\."
    ) as refused:
        read_outcomes(path)
    assert len(str(refused.value)) < 600


def test_empty_cells_are_refused(tmp_path):
    path = tmp_path / "outcomes.parquet"
    write_outcomes(path, [outcome()])
    table = pq.read_table(path)
    empty = table.set_column(0, "scene", pa.array([None], pa.string()))
    pq.write_table(empty.cast(table.schema), path)
    with pytest.raises(StoredFileError, match="empty cells"):
        read_outcomes(path)
