"""The baseline: one detector on one set of images without camouflage."""

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from skyproof.ranges import Fraction, Name, WholeNumber
from skyproof.results.statistics.intervals import Interval

# The largest loss of F1 with which a frozen threshold carries over.
_FAR = 0.03

_Share = Annotated[Interval, Meta(ge=0, le=1)]
_Threshold = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class BestF1:
    """The score threshold of the largest F1 on one set."""

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

    Intervals are over the clusters ("places" or "images"); undefined numbers are nan. Precision,
    recall and false alarms are at the frozen threshold by centre distance.

    Attributes:
        real: whether a camera took the images.
        best: best threshold on these images, if known.
        note: source and processing of the images.
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
        """Whether F1 at the frozen threshold is within three points of the best, or not known."""
        if self.best is None:
            return True
        return not self.best.f1 - f1(self.precision.estimate, self.recall.estimate) > _FAR


def f1(precision: float, recall: float) -> float:
    """Gives the harmonic mean; 0 where both are, nan where one is undefined."""
    return 2 * precision * recall / (precision + recall) if precision + recall != 0 else 0.0
