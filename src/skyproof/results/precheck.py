"""The record of a precheck, `precheck.json` beside a detector's card. Needs no torch."""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from msgspec import Meta, Struct

from skyproof.detectors.card import read_card
from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import new_file, write_json
from skyproof.ranges import Count, Fraction, Name, Seed
from skyproof.results.baseline import Baseline
from skyproof.results.rows_file import flat_row, row_form, row_of
from skyproof.results.statistics.intervals import Interval

PRECHECK_FILE = "precheck.json"

_FORMAT = 1
_REMEDY = "copy the whole folder again, or move this file away and check the detector again"

Kind = Literal["paint_body", "paint_whole", "two_tone", "blur", "control", "sun"]
"""A plain paint on body panels or the whole vehicle, two tones on body panels, the sharpness of
vehicles, a random control, or the elevation of the sun."""

_PAINT = re.compile("#[0-9a-f]{6}")
_PAINTS: dict[Kind, re.Pattern[str]] = {
    "paint_body": _PAINT,
    "paint_whole": _PAINT,
    "two_tone": re.compile("(#[0-9a-f]{6}){2}"),
}

_Digest = Annotated[str, Meta(max_length=64)]
_Label = Annotated[str, Meta(min_length=1, max_length=300)]
_Text = Annotated[str, Meta(max_length=10_000)]


@dataclass(frozen=True)
class Rate:
    """The share of vehicles that one change hides from one detector.

    The name is "#ff8000", "#ff8000#007fff" (upper half first), "0.7 px", "R-PixFc" or "25°". EASR
    is the mean of several draws for random controls.
    """

    kind: Kind
    name: _Label
    draws: Count
    easr: Annotated[Interval, Meta(ge=-1e6, le=1)]


@dataclass(frozen=True)
class MeasuredOn:
    """The identity of a precheck. Digests that an older record lacks are empty.

    Attributes:
        sources: sources of the ground, or ("procedural",).
        draws: draws of each random control.
        seed: seed of random controls and of the bootstrap.
        frames, frames_sha256: name of each annotated set, and digest of its images' names, sizes
            and labels and of its note.
        ground_sha256: digest of the index of the tiles.
        fleet_sha256: digest of the names and sizes of the vehicles.
    """

    scenes: Count
    scenes_sha256: _Digest
    sources: tuple[_Text, ...]
    draws: Count
    seed: Seed
    frames: tuple[_Label, ...] = ()
    frames_sha256: tuple[_Digest, ...] = ()
    ground_sha256: _Digest = ""
    fleet_sha256: _Digest = ""

    def differing(self, other: Self) -> list[str]:
        """Names the differences of two prechecks that both records know."""
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

    The digest of the weights is empty for a black box.
    """

    detector: str
    weights_sha256: str
    threshold: float
    measured_on: MeasuredOn
    sets: Sequence[Baseline]
    rates: Sequence[Rate]

    def of_kind(self, kind: Kind) -> list[Rate]:
        """The rates of one kind of change."""
        return [rate for rate in self.rates if rate.kind == kind]


def write_precheck(folder: Path, record: PrecheckRecord) -> None:
    """Writes `precheck.json`, whole or not at all, into a detector folder that has none."""
    path = folder / PRECHECK_FILE
    rows = {
        "measured_on": asdict(record.measured_on),
        "sets": [flat_row(baseline) for baseline in record.sets],
        "rates": [flat_row(rate) for rate in record.rates],
    }
    with new_file(path):
        write_json(path, {"format": _FORMAT, **vars(record), **rows})


def read_precheck(folder: Path) -> PrecheckRecord:
    """Reads the `precheck.json` of a detector folder."""
    path = folder / PRECHECK_FILE
    stored: _PrecheckDocument = read_document(path, _PrecheckDocument, _REMEDY, version=_FORMAT)
    for row in stored.rates:
        form = _PAINTS.get(row.kind)
        if form is not None and not form.fullmatch(row.name):
            raise StoredFileError(
                f"{path} names a paint {row.name[:60]!r}, expected its colour such as #ff8000; "
                f"{_REMEDY}."
            )
    return PrecheckRecord(
        detector=stored.detector,
        weights_sha256=stored.weights_sha256,
        threshold=stored.threshold,
        measured_on=stored.measured_on,
        sets=[row_of(Baseline, row) for row in stored.sets],
        rates=[row_of(Rate, row) for row in stored.rates],
    )


def read_prechecks(detectors: Path) -> dict[str, PrecheckRecord]:
    """Reads the records of all detector folders in a folder, by detector.

    A record of other weights or another threshold than the card beside it is left out.
    """
    records = {}
    for path in sorted(detectors.glob(f"*/{PRECHECK_FILE}")):
        record = read_precheck(path.parent)
        card = read_card(path.parent)
        if (record.weights_sha256, record.threshold) == (card.weights_sha256, card.threshold):
            records[record.detector] = record
    return records


_BaselineRow: Any = row_form(Baseline)
_RateRow: Any = row_form(Rate)


class _PrecheckDocument(Struct, frozen=True):
    """The form of `precheck.json`, beside its format."""

    detector: Name
    weights_sha256: _Digest
    threshold: Fraction
    measured_on: MeasuredOn
    sets: Annotated[list[_BaselineRow], Meta(min_length=1, max_length=1000)]
    rates: Annotated[list[_RateRow], Meta(max_length=10_000)]
