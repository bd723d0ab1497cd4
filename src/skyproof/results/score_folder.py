"""A score folder: all that was measured in one go, and all that a report needs of it.

It holds `score.json`, `outcomes.parquet`, `sets.json`, `baselines.json`,
`detections/`, `pairs/` (pictures of some scenes), `patterns/` (what some camouflages look like) and
`practicality.json`. `score.json` and `baselines.json` are always there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from skyproof.camouflage.name import CamouflageName
from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.ranges import FileReference, Fraction, Name, Seed, WholeNumber
from skyproof.results.baseline import Baseline
from skyproof.results.rows_file import read_rows
from skyproof.results.stored import Label, Practicality, Text


@dataclass(frozen=True)
class ScoreRecord:
    """What a score folder says of itself.

    Attributes:
        thresholds: by detector, its frozen threshold; in the order in which they were given.
        seed: of the bootstrap.
        renderer: who drew the compared images; None where none were compared.
        sources: what the ground of these images was cut from, or ["procedural"]; empty where it
            is not known.
    """

    thresholds: Mapping[Name, Annotated[float, Meta(ge=-1e6, le=1e6)]]
    seed: Seed = 0
    renderer: Name | None = None
    sources: Sequence[Text] = ()


@dataclass(frozen=True)
class Pair:
    """Two pictures of one scene, without and with a camouflage, as one detector sees them.

    Attributes:
        camouflage, detector, scene: which they are.
        why: why the scene was chosen.
        vehicles, found_before, found_after: how many there are and were found.
        original, adversarial: files, relative to the folder's `pairs`.
    """

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
    """One detector on one whole set of images; a row of `sets.json`.

    Attributes:
        camouflage: as in the outcomes; "original" for the images without camouflage.
        renderer, detector, match: as in the outcomes.
        average_precision: in [0, 1]; nan where undefined.
        false_alarms_per_km2: at the frozen threshold; nan where undefined.
    """

    camouflage: Name
    renderer: Name
    detector: Name
    match: str
    average_precision: Fraction
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)]


class _Pairs(Struct, frozen=True):
    rows: list[Pair]


class _Account(Struct, frozen=True):
    rows: list[Practicality]


_REMEDY = "copy the whole folder again, or score again"


def is_pictured(name: CamouflageName) -> bool:
    """Says whether pairs, portrait and practicality of a camouflage are kept.

    They are of learnt ones as they finally are, and of the first of several repeats.
    """
    return not name.random and not name.variant and name.repeat in ("", "0")


def write_record(folder: Path, record: ScoreRecord) -> None:
    """Writes `score.json`."""
    write_json(folder / "score.json", asdict(record))


def write_pairs(folder: Path, pairs: Sequence[Pair]) -> None:
    """Writes `pairs/pairs.json`, which names the pictures beside it."""
    write_json(folder / "pairs" / "pairs.json", {"rows": [asdict(pair) for pair in pairs]})


@dataclass(frozen=True)
class ScoreFolder:
    """A score folder, opened.

    Attributes:
        path: where it lies.
        record: what it says of itself.
    """

    path: Path
    record: ScoreRecord

    @classmethod
    def open(cls, path: Path) -> ScoreFolder:
        """Reads a score folder's record.

        Raises:
            StoredFileError: `score.json` is missing or damaged.
        """
        return cls(path, read_document(path / "score.json", ScoreRecord, _REMEDY))

    @classmethod
    def all_of(cls, run_folder: Path) -> list[ScoreFolder]:
        """Opens all score folders of a run, or the folder itself where it is one; by their names.

        Raises:
            StoredFileError: there is none, or one is damaged.
        """
        if (run_folder / "score.json").exists():
            return [cls.open(run_folder)]
        places = sorted(
            path
            for path in Layout(run_folder).scores.glob("*")
            # What is hidden is being made, or a kill left it.
            if path.is_dir() and not path.name.startswith(".")
        )
        if not places:
            raise StoredFileError(
                f"{run_folder} holds no scores; run skyproof score --out "
                f"{run_folder / 'scores' / 'NAME'}, or give another run folder."
            )
        return [cls.open(place) for place in places]

    def pairs(self) -> list[Pair]:
        """Gives the pictured scenes; empty where there are none.

        Raises:
            StoredFileError: `pairs.json` is damaged.
        """
        path = self.path / "pairs" / "pairs.json"
        if not path.exists():
            return []
        return read_document(path, _Pairs, _REMEDY).rows

    def baselines(self) -> list[Baseline]:
        """Gives how good the detectors are without camouflage.

        Raises:
            StoredFileError: `baselines.json` is missing or damaged.
        """
        return read_rows(self.path / "baselines.json", Baseline, _REMEDY)

    def sets(self) -> list[SetScore]:
        """Gives average precision and false alarms of every set that was compared.

        Raises:
            StoredFileError: `sets.json` is missing or damaged.
        """
        return read_rows(self.path / "sets.json", SetScore, _REMEDY)

    def practicality(self) -> list[Practicality]:
        """Says what the camouflages ask of those who would make them; empty where not measured.

        Raises:
            StoredFileError: `practicality.json` is damaged.
        """
        path = self.path / "practicality.json"
        if not path.exists():
            return []
        return read_document(path, _Account, _REMEDY).rows
