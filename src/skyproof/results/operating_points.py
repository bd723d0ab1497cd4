"""Operating points of a detector: its frozen threshold, and two with given false alarms."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from skyproof.results.result import FROZEN, MEAN, Result, summarise
from skyproof.results.score_folder import Baseline, ScoreFolder, merge_scores
from skyproof.words import detector_name, number

EQUAL_ALARMS = {"100_per_km2": 100, "10_per_km2": 10}
"""False alarms per km² of empty ground at the operating points other than the frozen threshold."""

_FEWEST = 3
"""Expected false alarms below which chance alone would choose the threshold."""


@dataclass(frozen=True)
class OperatingPoint:
    """A threshold with its false alarms per km² of empty ground; all nan if `why` gives a reason.

    Chance in the number of false alarms (95 %) puts it between `lowest` and `highest`.
    """

    detector: str
    name: str
    threshold: float
    false_alarms_per_km2: float
    lowest: float = math.nan
    highest: float = math.nan
    why: str = field(default="", kw_only=True)


def points_of(ground: Baseline) -> list[OperatingPoint]:
    """Returns a detector's operating points from its baseline on empty ground, frozen first.

    For a given rate, this is the lowest threshold with at most so many false alarms, midway between
    two scores. Equal scores count together. Chance is that of a Poisson number of clusters: one
    object on the ground often raises several alarms.
    """
    frozen = (FROZEN, ground.threshold, ground.false_alarms_per_km2)
    points = [OperatingPoint(ground.detector, *frozen)]
    scores = ground.alarm_scores
    for name, rate in EQUAL_ALARMS.items():
        expected = rate * ground.area_km2
        count = math.floor(expected + 1e-9)
        reached = count < len(scores)
        while reached and count and scores[count - 1] == scores[count]:
            count -= 1
        if expected < _FEWEST:
            why = (
                f"cannot be told on {ground.area_km2:.2g} km² of empty ground, where "
                f"{expected:.1f} are expected and at least {_FEWEST} are needed"
            )
        elif not reached:
            every = number(len(scores) / ground.area_km2)
            lowest = f", down to a score of {scores[-1]:.2f}," if scores else ""
            why = f"are not reached, because all detections{lowest} make {every}"
        else:
            why = "" if count else "are not reached, because more share the highest score"
        values = [math.nan, math.nan]
        if not why:
            values = [(scores[count - 1] + scores[count]) / 2, count / ground.area_km2]
            clusters = Counter(ground.alarm_clusters[:count] or range(count))
            spread = 1.96 * math.sqrt(sum(size**2 for size in clusters.values()))
            ends = (round(count + spread), max(round(count - spread), 1) - 1)
            values += [scores[min(end, len(scores) - 1)] for end in ends]
        points.append(OperatingPoint(ground.detector, name, *values, why=why))
    return points


def equal_alarm_rows(
    scores: Sequence[ScoreFolder], points: Mapping[str, Sequence[OperatingPoint]], seed: int
) -> list[Result]:
    """Returns the table at each operating point, without the detectors that do not reach it.

    `points` are by scoring detector. The mean is given where all of them do. Intervals cover the
    chance in the number of false alarms: all thresholds move down together, or up.
    """
    rows: list[Result] = []
    for name in EQUAL_ALARMS:
        reached = [
            one for own in points.values() for one in own if one.name == name and not one.why
        ]
        if reached:
            (counts, sets), *ends = (
                merge_scores(scores, {one.detector: getattr(one, which) for one in reached})
                for which in ("threshold", "lowest", "highest")
            )
            counts = replace(counts, ends=[end.series for end, _ in ends])
            rows += [
                replace(row, operating_point=name)
                for row in summarise(counts, sets, seed=seed)
                if row.detector != MEAN or len(reached) == len(points)
            ]
    return rows


def alarms_in_words(points: Mapping[str, Sequence[OperatingPoint]]) -> list[str]:
    """Says for each detector how many false alarms its thresholds allow."""
    sentences = []
    for detector, (frozen, *others) in ((name, own) for name, own in points.items() if own):
        further = ""
        for one in others:
            at = f"are at {one.threshold:.2f} ({one.lowest:.2f} to {one.highest:.2f} by chance)"
            further += f" {EQUAL_ALARMS[one.name]} per km² {one.why or at}."
        sentences.append(
            f"The frozen threshold of {detector_name(detector)}, {frozen.threshold:.2f}, stands at "
            f"{number(frozen.false_alarms_per_km2)} false alarms per km² of empty ground.{further}"
        )
    return sentences
