"""How good one detector is on one set of images without camouflage, as it is stored and shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyproof.errors import StoredFileError
from skyproof.files import read_json, write_json
from skyproof.results.statistics.intervals import Interval

__all__ = ["Check", "read_checks", "write_checks"]


@dataclass(frozen=True)
class Check:
    """One detector on one set of images without camouflage.

    Attributes:
        detector: its name.
        dataset: the set's name.
        images, vehicles: how many there are.
        real: whether a camera took the images.
        ap_centre_1m: average precision by centre distance with its interval; nan where undefined.
        clustered_by: what the interval is over, "places" or "images".
        clusters: how many of these there are.
        ap_iou_50: average precision by overlap.
        precision, recall: at the frozen threshold; nan where undefined.
        threshold: the detector's frozen threshold.
        note: where the images come from and what was done to them.
    """

    detector: str
    dataset: str
    images: int
    vehicles: int
    real: bool
    ap_centre_1m: Interval
    clustered_by: str
    clusters: int
    ap_iou_50: float
    precision: float
    recall: float
    threshold: float
    note: str = ""

    def json(self) -> dict[str, Any]:
        """Gives the check as flat JSON values, undefined ones as None."""
        values = {
            "detector": self.detector,
            "dataset": self.dataset,
            "images": self.images,
            "vehicles": self.vehicles,
            "real": self.real,
            "ap_centre_1m": self.ap_centre_1m.estimate,
            "ap_centre_1m_low": self.ap_centre_1m.low,
            "ap_centre_1m_high": self.ap_centre_1m.high,
            "clustered_by": self.clustered_by,
            "clusters": self.clusters,
            "ap_iou_50": self.ap_iou_50,
            "precision": self.precision,
            "recall": self.recall,
            "threshold": self.threshold,
            "note": self.note,
        }
        return {key: None if value != value else value for key, value in values.items()}


def write_checks(path: Path, checks: Sequence[Check]) -> None:
    """Writes checks as JSON, whole or not at all."""
    write_json(path, {"rows": [check.json() for check in checks]})


def read_checks(path: Path) -> list[Check]:
    """Reads what `write_checks` wrote.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    content = read_json(path)
    try:
        return [_check(row) for row in content["rows"]]
    except (TypeError, KeyError, AttributeError) as error:
        raise StoredFileError(
            f"{path} is not of the form this version writes; score again."
        ) from error


def _check(row: dict[str, Any]) -> Check:
    values: dict[str, Any] = {
        key: math.nan if value is None else value for key, value in row.items()
    }
    name = "ap_centre_1m"
    ap = Interval(values.pop(name), values.pop(f"{name}_low"), values.pop(f"{name}_high"))
    return Check(ap_centre_1m=ap, **values)
