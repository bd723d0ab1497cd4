"""Outcomes on disk."""

import dataclasses
import math

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from skyproof.errors import StoredFileError
from skyproof.results.pairs.outcomes import Outcome, read_outcomes, write_outcomes


def outcome(**changes):
    values = {
        field.name: {"str": "x", "int": 3, "bool": True, "float": 0.1}[field.type]
        for field in dataclasses.fields(Outcome)
    }
    return Outcome(**(values | changes))


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
