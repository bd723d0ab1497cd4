"""Records of a run folder other than its scores, checked as they are read."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from skyproof.detectors.card import DetectorCard, read_card
from skyproof.documents import check_document, read_document, read_lines
from skyproof.errors import StoredFileError
from skyproof.ranges import Name, Seed, WholeNumber

Finite = Annotated[float, Meta(ge=-1e15, le=1e15)]
Number = Annotated[int, Meta(ge=-(10**15), le=10**15)] | Finite
Label = Annotated[str, Meta(min_length=1, max_length=300)]
Text = Annotated[str, Meta(max_length=10_000)]

_REMEDY = "copy the whole folder again, or move this file away"


class StoredSuite(Struct, frozen=True):
    """The suite of a run, with the names of all camouflages that it scores; empty in older runs."""

    version: WholeNumber
    sha256: Text
    scored: list[Name] = []


class RunConfig(Struct, frozen=True):
    """The part of a run's `config.json` that results and report need, and `every` setting."""

    title: Label | None = None
    seed: Seed | None = None
    imagery: Text | list[Text] = ""
    suite: StoredSuite | None = None
    every: Mapping[str, Any] = {}


class _Commands(Struct, frozen=True):
    commands: list[Text] = []


class Timing(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One row of `timings.json`: duration of a step, and the memory it held."""

    stage: Label
    name: Label | None = None
    seconds: Annotated[float, Meta(ge=0, le=1e9)]
    largest_memory_mb: Annotated[float, Meta(ge=0, le=1e9)] | None = None


class _Settings(Struct, frozen=True):
    method: Text = "skyproof"


class _Attack(Struct, frozen=True):
    detectors: dict[Label, Text] = {}
    settings: _Settings = _Settings()


class Convergence(Struct, frozen=True):
    """Mean EASR over detectors after half and all of an attack's steps, on scenes of no step."""

    steps: tuple[WholeNumber, WholeNumber]
    hidden: tuple[Finite, Finite]
    scenes: WholeNumber
    converged: bool


class Queries(Struct, frozen=True):
    """Number of images that a query attack showed the detector."""

    images: WholeNumber


class AttackRecord(Struct, frozen=True):
    """The record of how a camouflage was made; the sign test of its gradient is by detector."""

    attack: _Attack | None = None
    convergence: Convergence | None = None
    queries: Queries | None = None
    sign_test: dict[Label, dict[Label, Number | bool | Text | None]] | None = None

    @property
    def method(self) -> str | None:
        """The method of the attack, "skyproof" or "paper"; None without an attack."""
        return None if self.attack is None else self.attack.settings.method


class _Camouflage(Struct, frozen=True):
    record: AttackRecord | None = None


class _Tile(Struct, frozen=True):
    source: Text = ""


class _Index(Struct, frozen=True):
    tiles: list[_Tile] = []


class LogRow(Struct, frozen=True):
    """One row of a `steps.jsonl`: a step of training or attack, or a validation without loss."""

    step: Annotated[int, Meta(ge=0, le=10**9)]
    kind: Label | None = None
    loss: Finite | None = None
    losses: dict[Label, Finite] | None = None


# Each of the following raises StoredFileError for a file of another form.


def read_config(path: Path) -> RunConfig:
    """Reads a run's `config.json`; all defaults where it is missing."""
    if not path.exists():
        return RunConfig()
    every: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
    config: RunConfig = check_document(every, RunConfig, str(path), _REMEDY)
    return RunConfig(config.title, config.seed, config.imagery, config.suite, every)


def read_environment(path: Path) -> Mapping[str, Any]:
    """Reads `environment.json`: machine and versions; empty where missing."""
    if not path.exists():
        return {}
    every: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
    check_document(every, _Commands, str(path), _REMEDY)
    known: Any = dict[Label, Text | int | float | bool | list[Text] | None]
    return check_document(every, known, str(path), _REMEDY)


def read_timings(path: Path) -> list[Timing]:
    """Reads the durations of a run's steps; empty where missing."""
    return read_document(path, list[Timing], _REMEDY) if path.exists() else []


def read_detectors(folder: Path) -> dict[str, DetectorCard]:
    """Reads the cards of a run's detectors, by folder."""
    places = [path.parent for path in sorted(folder.glob("*/detector.json"))]
    return {place.name: read_card(place) for place in places}


def read_records(folder: Path) -> dict[str, AttackRecord]:
    """Reads the records of a run's camouflages, by folder."""
    return {
        path.parent.name: read_document(path, _Camouflage, _REMEDY).record or AttackRecord()
        for path in sorted(folder.glob("*/camouflage.json"))
    }


def read_sources(path: Path) -> list[str]:
    """Reads the sources of the tiles of a background set from its `index.json`."""
    index: _Index = read_document(path, _Index, _REMEDY)
    return [tile.source for tile in index.tiles]


def read_log(path: Path) -> list[LogRow]:
    """Reads the log of a training or an attack."""
    rows: list[LogRow] = read_lines(path, LogRow, _REMEDY)
    for row in rows:
        if row.kind != "validation" and row.loss is None and row.losses is None:
            raise StoredFileError(f"{path} has a row without a loss; {_REMEDY}.")
    return rows
