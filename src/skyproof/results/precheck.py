"""The record of a precheck, `precheck.json` beside a detector's card, and its findings. No torch.

An estimate within its limit passes. It fails if its whole 95 % interval lies beyond, so that a test
with few vehicles does not fail a detector by chance. In between it is borderline.
"""

import math
import operator
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Int
from msgspec import Meta, Struct, structs

from skyproof.detectors.card import LEAST_VEHICLES, Digest, read_card
from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import new_file, write_json
from skyproof.ranges import Count, Fraction, Name, Seed, WholeNumber
from skyproof.results.likeness import Likeness, sure
from skyproof.results.result import MAIN_MATCH
from skyproof.results.rows_file import flat_row, row_form, row_of
from skyproof.results.score_folder import Baseline
from skyproof.results.statistics.intervals import Interval
from skyproof.results.stored import Label, Text
from skyproof.scenes.scene import Scene, scenes_digest
from skyproof.words import detector_name, hides, interval, percent

PRECHECK_FILE = "precheck.json"

_FORMAT = 1
_REMEDY = "copy the whole folder again, or move this file away and check the detector again"

Kind = Literal["paint_body", "paint_whole", "two_tone", "blur", "control", "sun"]
"""A plain paint on body panels or the whole vehicle, two tones on body panels, the sharpness of
vehicles, a random control, or the elevation of the sun."""

_COLOUR = "#[0-9a-f]{6}"

PAINTED: dict[Kind, str] = {
    "paint_body": "on body panels",
    "paint_whole": "on the whole vehicle",
    "two_tone": "on body panels",
}
"""Where each kind of plain paint goes."""

LEAST_AP_RENDERED = 0.95
"""Smallest baseline AP (centre within 1 m) on rendered scenes."""

LEAST_AP_PHOTOGRAPHS = 0.85
"""Smallest baseline AP on photographs, which are new to a detector trained on renders."""

LARGEST_EASR = 0.05
"""Largest EASR of a change without optimisation: the paper's random controls hide 1 to 4 %."""

FindingOutcome = Literal["passed", "borderline", "failed"]

_SEVERITY: dict[FindingOutcome, int] = {"passed": 0, "borderline": 1, "failed": 2}
_MANY: dict[Kind, str] = {
    "paint_body": "plain paints on body panels",
    "paint_whole": "plain paints on the whole vehicle",
    "two_tone": "two-tone paints",
    "blur": "degrees of blur",
    "control": "random controls",
    "sun": "elevations of the sun",
}

_Counts = Annotated[tuple[WholeNumber, ...], Meta(max_length=10_000)]


@dataclass(frozen=True)
class Rate:
    """The share of vehicles that one change hides from one detector.

    The name is "#ff8000", "#ff8000#007fff" (upper half first), "0.7 px", "R-PixFc" or "25°". EASR
    is the mean of several draws for random controls. For paints, the vehicles lost are also counted
    by tile, in the order of the record's `found_by_tile`; older records lack both.
    """

    kind: Kind
    name: Label
    draws: Count
    easr: Annotated[Interval, Meta(ge=-1e6, le=1)]
    lost_by_tile: _Counts = ()


@dataclass(frozen=True)
class MeasuredOn:
    """The identity of a precheck; digests that an older record lacks are empty."""

    scenes: Count
    scenes_sha256: Digest
    sources: tuple[Text, ...]
    draws: Count
    seed: Seed
    frames: tuple[Label, ...] = ()
    frames_sha256: tuple[Digest, ...] = ()
    ground_sha256: Digest = ""
    fleet_sha256: Digest = ""

    def differing(self, other: "MeasuredOn") -> list[str]:
        """Names what differs between two prechecks, as far as both records hold it."""
        words = {
            "frames_sha256": "images or labels of frames",
            "ground_sha256": "ground",
            "fleet_sha256": "vehicles",
        }
        return [
            words.get(name, name)
            for name, value in vars(self).items()
            if value != getattr(other, name)
            and not (name in words and (not value or not getattr(other, name)))
        ]


@dataclass(frozen=True)
class PrecheckRecord:
    """The precheck of one detector; `sets` are the unchanged scenes, then each annotated set.

    `found_by_tile` are the vehicles found on each tile of the scenes without a change. `likeness`
    compares rendered and photographed vehicles, where the annotated sets show the same ground.
    """

    detector: str
    weights_sha256: str
    threshold: float
    measured_on: MeasuredOn
    sets: Sequence[Baseline]
    rates: Sequence[Rate]
    found_by_tile: Sequence[int] = ()
    likeness: Sequence[Likeness] = ()

    def of_kind(self, kind: Kind) -> list[Rate]:
        """The rates of one kind of change."""
        return [rate for rate in self.rates if rate.kind == kind]

    @property
    def paints_tried(self) -> int:
        """The number of plain paints that were counted by tile; 0 in an older record."""
        return sum(rate.kind in PAINTED and bool(rate.lost_by_tile) for rate in self.rates)

    def failed_paints(self) -> dict[str, tuple[Int[np.ndarray, " C"], Int[np.ndarray, " C"]]]:
        """Returns vehicles found before and lost per tile, for each paint that failed, in words.

        A paint that hides some vehicles but reveals as many others does not fail.
        """
        found = np.array(self.found_by_tile, dtype=np.int64)
        return {
            f"{rate_words(rate)} {PAINTED[rate.kind]}": (found, np.array(rate.lost_by_tile))
            for rate in self.rates
            if rate.kind in PAINTED and rate.lost_by_tile and rate_outcome(rate) == "failed"
        }

    @property
    def likeness_by_main_rule(self) -> Likeness | None:
        """The comparison that decides; None where it was not measured."""
        return next((row for row in self.likeness if row.match == MAIN_MATCH), None)

    def was_made_on(self, scenes: Sequence[Scene]) -> bool:
        """Whether these scenes begin with those of the precheck."""
        return self.measured_on.scenes_sha256 == scenes_digest(scenes[: self.measured_on.scenes])


def write_precheck(folder: Path, record: PrecheckRecord) -> None:
    """Writes `precheck.json`, whole or not at all, into a detector folder that has none."""
    path = folder / PRECHECK_FILE
    rows = {name: [flat_row(row) for row in getattr(record, name)] for name in _ROWS}
    document = {"format": _FORMAT, **vars(record), **rows}
    document["measured_on"] = asdict(record.measured_on)
    if not record.likeness:
        # Records on drawn ground keep their earlier form.
        del document["likeness"]
    with new_file(path):
        write_json(path, document)


def read_precheck(folder: Path) -> PrecheckRecord:
    """Reads the `precheck.json` of a detector folder."""
    path = folder / PRECHECK_FILE
    stored: _PrecheckDocument = read_document(path, _PrecheckDocument, _REMEDY, version=_FORMAT)
    for row in stored.rates:
        form = 2 * _COLOUR if row.kind == "two_tone" else _COLOUR
        if row.kind in PAINTED and not re.fullmatch(form, row.name):
            raise StoredFileError(
                f"{path} names a paint {row.name[:60]!r}, expected its colour such as #ff8000; "
                f"{_REMEDY}."
            )
        lost, found = row.lost_by_tile, stored.found_by_tile
        if lost and (len(lost) != len(found) or any(map(operator.gt, lost, found))):
            raise StoredFileError(
                f"{path} counts other vehicles lost in the paint {row.name} than were found; "
                f"{_REMEDY}."
            )
    rows = {
        name: [row_of(kind, row) for row in getattr(stored, name)] for name, kind in _ROWS.items()
    }
    return PrecheckRecord(**structs.asdict(stored) | rows)


def read_prechecks(detectors: Path) -> dict[str, PrecheckRecord]:
    """Reads all records in a folder of detectors, except those of other weights or thresholds."""
    records = {}
    for path in sorted(detectors.glob(f"*/{PRECHECK_FILE}")):
        record = read_precheck(path.parent)
        card = read_card(path.parent)
        if (record.weights_sha256, record.threshold) == (card.weights_sha256, card.threshold):
            records[record.detector] = record
    return records


_ROWS = {"sets": Baseline, "rates": Rate, "likeness": Likeness}
_BaselineRow: Any = row_form(Baseline)
_RateRow: Any = row_form(Rate)
_LikenessRow: Any = row_form(Likeness)


class _PrecheckDocument(Struct, frozen=True):
    """The form of `precheck.json`, beside its format."""

    detector: Name
    weights_sha256: Digest
    threshold: Fraction
    measured_on: MeasuredOn
    sets: Annotated[list[_BaselineRow], Meta(min_length=1, max_length=1000)]
    rates: Annotated[list[_RateRow], Meta(max_length=10_000)]
    found_by_tile: _Counts = ()
    likeness: Annotated[list[_LikenessRow], Meta(max_length=1000)] = []


@dataclass(frozen=True)
class Finding:
    """The finding of one criterion, as a clause and as a cell of a table.

    `beyond` is how far the estimate lies beyond its limit, below 0 if within. Rates are those of
    the changes, largest first, and none for a baseline.
    """

    criterion: str
    outcome: FindingOutcome
    words: str
    figure: str
    beyond: float
    rates: Sequence[Rate] = ()


def findings(record: PrecheckRecord) -> list[Finding]:
    """Judges a detector by every criterion that was measured."""
    baselines = [_baseline(baseline) for baseline in record.sets]
    changed = [(kind, record.of_kind(kind)) for kind in _MANY]
    return [*baselines, *(_changed(rates, kind) for kind, rates in changed if rates)]


def worst(found: Sequence[Finding]) -> Finding:
    """The finding that decides: of the worst outcome, and the farthest beyond its limit."""
    return max(found, key=lambda each: (_SEVERITY[each.outcome], each.beyond))


def misses_vehicles(record: PrecheckRecord) -> bool:
    """Whether a detector fails even without random controls, so that it misses usual vehicles."""
    changes = [rate for rate in record.rates if rate.kind != "control"]
    return worst(findings(replace(record, rates=changes))).outcome == "failed"


def rate_outcome(rate: Rate) -> FindingOutcome:
    """The outcome of one change alone."""
    return _outcome(rate.easr, -LARGEST_EASR, sign=-1)


def misfit_thresholds(baselines: Sequence[Baseline]) -> list[str]:
    """Names each set to which the frozen threshold does not carry over, in a sentence each."""
    return [
        f"The frozen threshold of {detector_name(check.detector)}, {check.threshold:.2f}, does not "
        f"carry over to {check.dataset}: recall {percent(check.recall.estimate)} at precision "
        f"{percent(check.precision.estimate)}; the best one there, {check.best.threshold:.2f}, has "
        f"{percent(check.best.recall)} at {percent(check.best.precision)}."
        for check in baselines
        if check.best is not None and not check.carries_over and check.vehicles >= LEAST_VEHICLES
    ]


def rate_words(rate: Rate) -> str:
    """The change in words: the paint "#ff8000" as "RGB (255, 128, 0)"."""
    if rate.kind in PAINTED:
        colours = rate.name.removeprefix("#").split("#")
        return "RGB " + " over ".join(str(tuple(bytes.fromhex(colour))) for colour in colours)
    return rate.name


def _baseline(baseline: Baseline) -> Finding:
    least = LEAST_AP_PHOTOGRAPHS if baseline.real else LEAST_AP_RENDERED
    ap = baseline.ap_centre_1m
    lenient = f", {baseline.leniently}" if baseline.leniently else ""
    return Finding(
        f"baseline AP on {baseline.dataset}",
        _outcome(ap, least, sign=1),
        f"its AP on {baseline.dataset} is {sure(ap)} (limit {percent(least)}){lenient}",
        sure(ap),
        least - ap.estimate,
    )


def _changed(rates: Sequence[Rate], kind: Kind) -> Finding:
    """Judges all changes of a kind by the worst of them."""
    many = _MANY[kind]
    ordered = sorted(rates, key=lambda rate: (-_SEVERITY[rate_outcome(rate)], -rate.easr.estimate))
    largest = ordered[0]
    beyond = [rate for rate in rates if rate.easr.estimate > LARGEST_EASR]
    limits = f" ({interval(largest.easr.low, largest.easr.high)})"
    done = hides(largest.easr.estimate) + ("" if math.isnan(largest.easr.low) else limits)
    if not beyond:
        words = f"of {len(rates)} {many} the worst, {rate_words(largest)}, {done}"
    else:
        words = (
            f"{len(beyond)} of {len(rates)} {many} hide{'s' if len(beyond) == 1 else ''} more than "
            f"{percent(LARGEST_EASR)}; the worst, {rate_words(largest)}, {done}"
        )
    excess = largest.easr.estimate - LARGEST_EASR
    figure = f"{rate_words(largest)} {sure(largest.easr)}"
    return Finding(many, rate_outcome(largest), words, figure, excess, ordered)


def _outcome(value: Interval, limit: float, *, sign: int) -> FindingOutcome:
    """Judges whether sign * value reaches a limit; an undefined interval excludes nothing."""
    ends = [sign * end for end in (value.low, value.high) if not math.isnan(end)]
    if sign * value.estimate >= limit:
        return "passed"
    return "failed" if ends and max(ends) < limit else "borderline"
