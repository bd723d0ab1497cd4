"""How good one detector is on one set of images without camouflage, as it is stored and shown."""

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, Name, WholeNumber
from skyproof.results.statistics.intervals import Interval

_FAR = 0.03
"""A frozen threshold that costs more of F1 than this does not carry over."""

_Share = Annotated[Interval, Meta(ge=0, le=1)]
_Threshold = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class BestF1:
    """The score threshold of the largest F1 on one set, and what is reached there."""

    threshold: _Threshold
    precision: Fraction
    recall: Fraction

    @property
    def f1(self) -> float:
        """The harmonic mean of both."""
        return f1(self.precision, self.recall)


@dataclass(frozen=True)
class Baseline:
    """One detector on one set of images without camouflage; a row of `baselines.json`.

    Attributes:
        detector, dataset: names.
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
        best: what another threshold would have given here; None where it is not known.
        note: where the images come from and what was done to them.
    """

    detector: Name
    dataset: Annotated[str, Meta(min_length=1, max_length=300)]
    images: WholeNumber
    vehicles: Annotated[int, Meta(ge=0, le=10**9)]
    real: bool
    ap_centre_1m: _Share
    clustered_by: Annotated[str, Meta(min_length=1, max_length=50)]
    clusters: WholeNumber
    ap_iou_50: Fraction
    precision: _Share
    recall: _Share
    threshold: _Threshold
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)] = math.nan
    best: BestF1 | None = None
    note: Annotated[str, Meta(max_length=10_000)] = ""

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


def f1(precision: float, recall: float) -> float:
    """Gives the harmonic mean; 0 where both are, nan where one is undefined."""
    return 2 * precision * recall / (precision + recall) if precision + recall != 0 else 0.0
