"""A score folder: all measurements of one call, and everything that a report needs of them.

It holds `score.json`, `outcomes.parquet`, `sets.json`, `baselines.json`, `detections/`, `pairs/`
(pictures of some scenes), `patterns/` (pictures of some camouflages) and `practicality.json`.
`score.json` and `baselines.json` are always there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Self

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
    """Contents of `score.json`.

    Attributes:
        thresholds: frozen threshold of each detector, in the order in which they were given.
        seed: seed of the bootstrap.
        renderer: renderer of the compared images; None without any.
        sources: sources of their ground, or ["procedural"]; empty if unknown.
    """

    thresholds: Mapping[Name, Annotated[float, Meta(ge=-1e6, le=1e6)]]
    seed: Seed = 0
    renderer: Name | None = None
    sources: Sequence[Text] = ()


@dataclass(frozen=True)
class Pair:
    """Two pictures of one scene, without and with a camouflage, as one detector sees them.

    Attributes:
        why: reason for the choice of the scene.
        vehicles, found_before, found_after: numbers of vehicles.
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

    The camouflage of the unchanged images is "original". The two numbers are nan where undefined,
    and false alarms are counted at the frozen threshold.
    """

    camouflage: Name
    renderer: Name
    detector: Name
    match: str
    average_precision: Fraction
    false_alarms_per_km2: Annotated[float, Meta(ge=0, le=1e12)]


class _Pairs(Struct, frozen=True):
    rows: list[Pair]


class _PracticalityFile(Struct, frozen=True):
    rows: list[Practicality]


_REMEDY = "copy the whole folder again, or score again"


def is_pictured(name: CamouflageName) -> bool:
    """Says whether pairs, portrait and practicality of a camouflage are kept: of finished optimised
    ones, and of the first of several repeats.
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
    """A score folder, opened. Reading a damaged file raises StoredFileError.

    Attributes:
        path: its place.
        record: contents of `score.json`.
    """

    path: Path
    record: ScoreRecord

    @classmethod
    def open(cls, path: Path) -> Self:
        """Reads a score folder's record."""
        return cls(path, read_document(path / "score.json", ScoreRecord, _REMEDY))

    @classmethod
    def all_of(cls, run_folder: Path) -> list[Self]:
        """Opens all score folders of a run by name, or the folder itself if it is one.

        Raises:
            StoredFileError: there is none, or one is damaged.
        """
        if (run_folder / "score.json").exists():
            return [cls.open(run_folder)]
        places = sorted(
            path
            for path in Layout(run_folder).scores.glob("*")
            # A hidden folder is being made, or a kill left it.
            if path.is_dir() and not path.name.startswith(".")
        )
        if not places:
            raise StoredFileError(
                f"{run_folder} holds no scores; run skyproof score --out "
                f"{run_folder / 'scores' / 'NAME'}, or give another run folder."
            )
        return [cls.open(place) for place in places]

    def pairs(self) -> list[Pair]:
        """Gives the pictured scenes; empty where there are none."""
        return self._optional(Path("pairs", "pairs.json"), _Pairs)

    def baselines(self) -> list[Baseline]:
        """Gives the baseline of each detector and dataset."""
        return read_rows(self.path / "baselines.json", Baseline, _REMEDY)

    def sets(self) -> list[SetScore]:
        """Gives average precision and false alarms of each set."""
        return read_rows(self.path / "sets.json", SetScore, _REMEDY)

    def practicality(self) -> list[Practicality]:
        """Gives the practicality of the pictured camouflages; empty where not measured."""
        return self._optional(Path("practicality.json"), _PracticalityFile)

    def _optional(self, file: Path, form: Any) -> list[Any]:
        path = self.path / file
        return list(read_document(path, form, _REMEDY).rows) if path.exists() else []
