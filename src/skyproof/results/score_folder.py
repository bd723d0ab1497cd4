"""A score folder: all measurements of one call, and everything that a report needs from them.

It holds `score.json`, `outcomes.parquet`, `sets.json`, `baselines.json`, `likeness.json`,
`pairs/` (pictures of some scenes) and `patterns/` (pictures of some camouflages). `score.json` and
`baselines.json` are always there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from msgspec import Meta

from skyproof.camouflage.name import CamouflageName
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.ranges import FileReference, Fraction, Name, Seed, WholeNumber
from skyproof.results.likeness import Likeness
from skyproof.results.outcomes import ORIGINAL, REMEDY, OutcomeCounts, Series, read_counts
from skyproof.results.rows_file import read_rows
from skyproof.results.statistics.intervals import Interval
from skyproof.results.stored import Label, Text
from skyproof.words import percent

LIKENESS = "likeness.json"
# The largest loss of F1 with which a frozen threshold carries over.
_FAR = 0.03

_Share = Annotated[Interval, Meta(ge=0, le=1)]
_Threshold = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class BestF1:
    """The score threshold with the largest F1 on one set that shows vehicles."""

    threshold: _Threshold
    precision: Fraction
    recall: Fraction


@dataclass(frozen=True)
class Baseline:
    """One detector on one set of images without camouflage; a row of `baselines.json`.

    Intervals are over the clusters ("places" or "images"); undefined numbers are nan. Precision,
    recall and false alarms are at the frozen threshold by centre distance, AP and recall also by
    the lenient rule, which older rows lack. Vehicles are called another class if only that is
    detected on them, which only detectors with other classes can show. A camera took `real` images,
    and the note states their source and processing. On rendered ground without vehicles, the
    highest scores of false alarms are kept in descending order: more than 100 per km², or all, each
    with the number of its cluster, which older rows lack.
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
    ap_centre_in_box: Fraction = math.nan
    recall_centre_in_box: Fraction = math.nan
    called_another_class: Fraction = math.nan
    area_km2: Annotated[float, Meta(ge=0, le=1e9)] = math.nan
    alarm_scores: Annotated[tuple[_Threshold, ...], Meta(max_length=10**7)] = ()
    alarm_clusters: Annotated[tuple[WholeNumber, ...], Meta(max_length=10**7)] = ()

    @property
    def leniently(self) -> str:
        """AP and recall by the lenient rule in words; empty where they are not known."""
        if math.isnan(self.ap_centre_in_box):
            return ""
        other = self.called_another_class
        return (
            f"by the lenient rule AP {percent(self.ap_centre_in_box)} and recall "
            f"{percent(self.recall_centre_in_box)}"
            + ("" if math.isnan(other) else f", called another class {percent(other)}")
        )

    @property
    def carries_over(self) -> bool:
        """Whether F1 at the frozen threshold is within three points of the best, or not known."""
        if self.best is None:
            return True
        largest = f1(self.best.precision, self.best.recall)
        return not largest - f1(self.precision.estimate, self.recall.estimate) > _FAR


def f1(precision: float, recall: float) -> float:
    """Returns the harmonic mean of both; 0 if both are 0, nan if one is undefined."""
    return 2 * precision * recall / (precision + recall) if precision + recall != 0 else 0.0


@dataclass(frozen=True)
class ScoreRecord:
    """Contents of `score.json`: thresholds in the order of detectors, and the bootstrap's seed."""

    thresholds: Mapping[Name, _Threshold]
    seed: Seed = 0
    renderer: Name | None = None
    sources: Sequence[Text] = ()


@dataclass(frozen=True)
class Pair:
    """One scene without and with a camouflage, in files relative to the folder's `pairs`."""

    camouflage: Name
    detector: Name
    scene: Name
    why: Label
    vehicles: WholeNumber
    found_before: WholeNumber
    found_after: WholeNumber
    original: FileReference
    adversarial: FileReference


@dataclass(frozen=True)
class SetScore:
    """One detector on one whole set of images, or "original"; a row of `sets.json`.

    By the lenient rule also the share of the vehicles found before on which only another class is
    detected, where it was measured: of optimised camouflages and detectors with other classes.
    """

    camouflage: Name
    renderer: Name
    detector: Name
    match: str
    average_precision: Fraction
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)]
    called_another_class: Fraction = math.nan


def is_pictured(name: CamouflageName) -> bool:
    """Whether pictures are kept, as for the first repeat of a finished attack."""
    return not name.random and not name.variant and name.repeat in ("", "0")


def write_record(folder: Path, record: ScoreRecord) -> None:
    """Writes `score.json`."""
    write_json(folder / "score.json", asdict(record))


@dataclass(frozen=True)
class ScoreFolder:
    """A score folder, opened. Reading a damaged file raises StoredFileError."""

    path: Path
    record: ScoreRecord

    @classmethod
    def open(cls, path: Path) -> Self:
        """Reads a score folder's record."""
        return cls(path, read_document(path / "score.json", ScoreRecord, REMEDY))

    @classmethod
    def all_of(cls, run_folder: Path, *, needed: bool = True) -> list[Self]:
        """Opens a run's score folders in order of their names, or the folder itself if it is one.

        If some are `needed` and there are none, StoredFileError is raised.
        """
        if (run_folder / "score.json").exists():
            return [cls.open(run_folder)]
        # A hidden folder is still being written, or was left behind by a killed process.
        places = sorted(path for path in Layout(run_folder).scores.glob("[!.]*") if path.is_dir())
        if needed and not places:
            raise StoredFileError(
                f"{run_folder} holds no scores; run skyproof score --out "
                f"{run_folder / 'scores' / 'NAME'}, or give another run folder."
            )
        return [cls.open(place) for place in places]

    def pairs(self) -> list[Pair]:
        """Returns the pictured scenes, with pictures beside `pairs.json`; empty without any."""
        path = self.path / "pairs" / "pairs.json"
        return read_rows(path, Pair, REMEDY) if path.exists() else []

    def baselines(self) -> list[Baseline]:
        """Returns the baseline of each detector and dataset."""
        return read_rows(self.path / "baselines.json", Baseline, REMEDY)

    def likeness(self) -> list[Likeness]:
        """Returns how photographed and rendered vehicles compare; empty where not measured."""
        path = self.path / LIKENESS
        return read_rows(path, Likeness, REMEDY) if path.exists() else []

    def sets(self) -> list[SetScore]:
        """Returns average precision and false alarms of each set."""
        return read_rows(self.path / "sets.json", SetScore, REMEDY)


def merge_scores(
    folders: Sequence[ScoreFolder], thresholds: Mapping[str, float] | None = None
) -> tuple[OutcomeCounts, list[SetScore]]:
    """Reads the outcomes and set scores of several score folders that share scenes and detectors.

    A result that several folders hold (that on the unchanged images always is one) must be equal in
    all of them. Folders that hold baselines alone are skipped. With `thresholds` as in
    `read_counts`, the set scores hold average precision only.
    """
    compared = [folder for folder in folders if folder.record.renderer]
    read = [
        (folder, read_counts(folder.path / "outcomes.parquet", thresholds)) for folder in compared
    ]
    cells = sorted({cell for _, counts in read for cell in counts.cells})
    place = {cell: index for index, cell in enumerate(cells)}
    series: dict[Series, tuple[ScoreFolder, np.ndarray]] = {}
    shown: dict[str, tuple[ScoreFolder, np.ndarray]] = {}
    for folder, counted in read:
        rows = [place[cell] for cell in counted.cells]
        for key, counts in counted.series.items():
            spread = np.zeros((len(cells), 4), dtype=np.int64)
            spread[rows] = counts
            first, known = series.setdefault(key, (folder, spread))
            if not np.array_equal(known, spread):
                raise _contradiction(first, folder, key)
            first, vehicles = shown.setdefault(key.renderer, (folder, spread[:, 0]))
            if not np.array_equal(vehicles, spread[:, 0]):
                raise ConfigurationError(
                    f"{first.path} and {folder.path} do not show the same vehicles on the same "
                    "tiles; put only scores of one scene file into one run."
                )
    _refuse_other_detectors({key: folder for key, (folder, _) in series.items()})
    sets = _merge_sets(compared)
    if thresholds is not None:
        nan = math.nan
        sets = [replace(each, false_alarms_per_km2=nan, called_another_class=nan) for each in sets]
    return OutcomeCounts(tuple(cells), {key: spread for key, (_, spread) in series.items()}), sets


def _refuse_other_detectors(source: dict[Series, ScoreFolder]) -> None:
    """Refuses repeats of a camouflage on different detectors, which would be left out silently."""
    scored: dict[tuple[CamouflageName, str], dict[str, set[str]]] = {}
    for key in source:
        pooled = (CamouflageName.read(key.camouflage).pooled, key.renderer)
        scored.setdefault(pooled, {}).setdefault(key.camouflage, set()).add(key.detector)
    for repeats in scored.values():
        every = set().union(*repeats.values())
        for name, own in repeats.items():
            if own != every:
                place = next(score.path for key, score in source.items() if key.camouflage == name)
                raise ConfigurationError(
                    f"{place} has {name} scored with {', '.join(sorted(own))}, and another repeat "
                    f"of it is scored with {', '.join(sorted(every))}; score all repeats with the "
                    "same detectors, or leave the folder out."
                )


def _merge_sets(folders: Sequence[ScoreFolder]) -> list[SetScore]:
    kept: dict[Series, tuple[ScoreFolder, SetScore]] = {}
    for folder in folders:
        for score in folder.sets():
            key = Series(score.camouflage, score.renderer, score.detector, score.match)
            first, other = kept.setdefault(key, (folder, score))
            here, there = (
                (each.average_precision, each.false_alarms_per_km2) for each in (score, other)
            )
            if not np.allclose(here, there, rtol=1e-9, atol=1e-12, equal_nan=True):
                raise _contradiction(first, folder, key)
    return [score for _, score in kept.values()]


def _contradiction(first: ScoreFolder, second: ScoreFolder, key: Series) -> ConfigurationError:
    what = "the images without camouflage" if key.camouflage == ORIGINAL else key.camouflage
    return ConfigurationError(
        f"{first.path} and {second.path} hold different results for {what} and {key.detector}; "
        "leave one of the folders out, or score both again with the same scenes and detectors."
    )
