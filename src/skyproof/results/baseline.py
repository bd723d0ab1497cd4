"""How good one detector is on one set of images without camouflage, as it is stored and shown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.files import write_json
from skyproof.ranges import Fraction, Name, WholeNumber
from skyproof.results.rows_file import nulls_for_undefined, read_rows
from skyproof.results.statistics.intervals import Interval

_FAR = 0.03
"""A frozen threshold that costs more of F1 than this does not carry over."""


@dataclass(frozen=True)
class BestF1:
    """The score threshold of the largest F1 on one set, and what is reached there."""

    threshold: float
    precision: float
    recall: float

    @property
    def f1(self) -> float:
        """The harmonic mean of both."""
        return f1(self.precision, self.recall)


@dataclass(frozen=True)
class Baseline:
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
        precision, recall: at the frozen threshold with their intervals, over the same places or
            images; nan where undefined.
        threshold: the detector's frozen threshold.
        false_alarms_per_km2: detections on no vehicle, from that threshold on, by centre distance;
            nan where it is not known.
        note: where the images come from and what was done to them.
        best: what another threshold would have given here; None where it is not known.
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
    precision: Interval
    recall: Interval
    threshold: float
    false_alarms_per_km2: float = math.nan
    note: str = ""
    best: BestF1 | None = None

    @property
    def carries_over(self) -> bool:
        """Whether the frozen threshold is about as good here as the best one would be.

        It is not where F1 falls short of the best threshold's by more than three points; on a set
        of which nothing is known, it is. Freezing takes the lowest of the thresholds that are
        nearly as good, which gives precision for recall, and F1 says what both are worth together.
        """
        if self.best is None:
            return True
        return not self.best.f1 - f1(self.precision.estimate, self.recall.estimate) > _FAR

    def json(self) -> dict[str, Any]:
        """Gives the check as flat JSON values, undefined ones as None."""
        best = self.best or BestF1(math.nan, math.nan, math.nan)
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
            "precision": self.precision.estimate,
            "precision_low": self.precision.low,
            "precision_high": self.precision.high,
            "recall": self.recall.estimate,
            "recall_low": self.recall.low,
            "recall_high": self.recall.high,
            "threshold": self.threshold,
            "false_alarms_per_km2": self.false_alarms_per_km2,
            "best_threshold": best.threshold,
            "best_precision": best.precision,
            "best_recall": best.recall,
            "note": self.note,
        }
        return nulls_for_undefined(values)


def f1(precision: float, recall: float) -> float:
    """Gives the harmonic mean; 0 where both are, nan where one is undefined."""
    return 2 * precision * recall / (precision + recall) if precision + recall != 0 else 0.0


def write_baselines(path: Path, checks: Sequence[Baseline]) -> None:
    """Writes checks as JSON, whole or not at all."""
    write_json(path, {"rows": [check.json() for check in checks]})


def read_baselines(path: Path) -> list[Baseline]:
    """Reads what `write_baselines` wrote.

    Raises:
        StoredFileError: the file is missing or of another form.
    """
    rows: list[StoredBaseline] = read_rows(
        path, StoredBaseline, "copy the whole folder again, or score again"
    )
    return [baseline_of(vars(row)) for row in rows]


def baseline_of(row: Mapping[str, Any]) -> Baseline:
    """Makes a check of the flat values of a `StoredBaseline`, undefined ones nan."""

    def sure(name: str) -> Interval:
        return Interval(row[name], row[f"{name}_low"], row[f"{name}_high"])

    best = BestF1(row["best_threshold"], row["best_precision"], row["best_recall"])
    plain = ("detector", "dataset", "images", "vehicles", "real", "clustered_by", "clusters")
    return Baseline(
        **{name: row[name] for name in (*plain, "ap_iou_50", "threshold", "note")},
        false_alarms_per_km2=row["false_alarms_per_km2"],
        ap_centre_1m=sure("ap_centre_1m"),
        precision=sure("precision"),
        recall=sure("recall"),
        best=None if math.isnan(best.threshold) else best,
    )


_Threshold = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class StoredBaseline:
    """A check as `Baseline.json` gives it.

    Checks of before there was a gate have an interval of the average precision alone.
    """

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
    threshold: _Threshold
    _: KW_ONLY
    precision_low: Fraction = math.nan
    precision_high: Fraction = math.nan
    recall_low: Fraction = math.nan
    recall_high: Fraction = math.nan
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)] = math.nan
    best_threshold: _Threshold = math.nan
    best_precision: Fraction = math.nan
    best_recall: Fraction = math.nan
    note: Annotated[str, Meta(max_length=10_000)] = ""
