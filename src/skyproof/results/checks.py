"""How good one detector is on one set of images without camouflage, as it is stored and shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.files import write_json
from skyproof.ranges import Fraction, Name, WholeNumber
from skyproof.results.rows_file import nulls_for_undefined, read_rows
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
        return nulls_for_undefined(values)


def write_checks(path: Path, checks: Sequence[Check]) -> None:
    """Writes checks as JSON, whole or not at all."""
    write_json(path, {"rows": [check.json() for check in checks]})


def read_checks(path: Path) -> list[Check]:
    """Reads what `write_checks` wrote.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    rows: list[_Stored] = read_rows(path, _Stored, "copy the whole folder again, or score again")
    return [
        Check(
            detector=row.detector,
            dataset=row.dataset,
            images=row.images,
            vehicles=row.vehicles,
            real=row.real,
            ap_centre_1m=Interval(row.ap_centre_1m, row.ap_centre_1m_low, row.ap_centre_1m_high),
            clustered_by=row.clustered_by,
            clusters=row.clusters,
            ap_iou_50=row.ap_iou_50,
            precision=row.precision,
            recall=row.recall,
            threshold=row.threshold,
            note=row.note,
        )
        for row in rows
    ]


@dataclass(frozen=True)
class _Stored:
    """A check as `Check.json` gives it."""

    detector: Name
    dataset: Annotated[str, Meta(min_length=1, max_length=300)]
    images: WholeNumber
    vehicles: Annotated[int, Meta(ge=0, le=10**9)]
    real: bool
    ap_centre_1m: Fraction
    ap_centre_1m_low: Fraction
    ap_centre_1m_high: Fraction
    clustered_by: Annotated[str, Meta(min_length=1, max_length=50)]
    clusters: WholeNumber
    ap_iou_50: Fraction
    precision: Fraction
    recall: Fraction
    threshold: Annotated[float, Meta(ge=-1e6, le=1e6)]
    note: Annotated[str, Meta(max_length=10_000)] = ""
