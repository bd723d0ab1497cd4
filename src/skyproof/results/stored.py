"""What a report reads of a run folder beside its scores, checked as it is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from skyproof.detectors.card import DetectorCard, read_card
from skyproof.documents import check_document, read_document, read_lines
from skyproof.errors import StoredFileError
from skyproof.ranges import Name, Seed, WholeNumber

Finite = Annotated[float, Meta(ge=-1e15, le=1e15)]
"""Any number that a table can show."""

Number = Annotated[int, Meta(ge=-(10**15), le=10**15)] | Finite
"""A number that stays whole where it is."""

Label = Annotated[str, Meta(min_length=1, max_length=300)]
"""A few words."""

Text = Annotated[str, Meta(max_length=10_000)]
"""Some sentences, or a command."""

_REMEDY = "copy the whole folder again, or move this file away"


class RunConfig(Struct, frozen=True):
    """What the results and the report need of a run's `config.json`.

    Attributes:
        title: of the report; None where it is not given.
        seed: of the bootstrap; None where it is not given.
        imagery: what the ground was cut from.
        every: all settings as plain values, to be shown.
    """

    title: Label | None = None
    seed: Seed | None = None
    imagery: Text | list[Text] = ""
    every: Mapping[str, Any] = {}


class _Commands(Struct, frozen=True):
    commands: list[Text] = []


class Timing(Struct, frozen=True, kw_only=True):
    """One row of `timings.json`: how long a step took, and what memory it held."""

    stage: Label
    name: Label | None = None
    seconds: Annotated[float, Meta(ge=0, le=1e9)]
    largest_memory_mb: Annotated[float, Meta(ge=0, le=1e9)] | None = None


class _Attack(Struct, frozen=True):
    detectors: dict[Label, Text] = {}


class Discretisation(Struct, frozen=True):
    """Every detector's loss before and after the last rounding."""

    before: dict[Label, Finite] = {}
    after: dict[Label, Finite] = {}


class Convergence(Struct, frozen=True):
    """What the second half of an attack's steps added, on scenes that none of them saw.

    Attributes:
        steps: half of them, and all.
        hidden: EASR after so many, mean over the detectors.
        scenes: how many it was measured on.
        converged: whether little was added.
    """

    steps: tuple[WholeNumber, WholeNumber]
    hidden: tuple[Finite, Finite]
    scenes: WholeNumber
    converged: bool


class Queries(Struct, frozen=True):
    """Of a camouflage that was sought by answers: how many images the detector was shown."""

    images: WholeNumber


class AttackRecord(Struct, frozen=True):
    """What the tables need of what was recorded while a camouflage was made.

    Attributes:
        attack: which detectors it was learnt against; None of one that was drawn.
        discretisation: every detector's loss before and after the last rounding.
        sign_test: by detector, what a few vehicles painted at random showed.
        convergence: whether more steps would have hidden more; None where it was not asked.
        queries: what a search by answers cost; None of what was learnt or drawn.
    """

    attack: _Attack | None = None
    convergence: Convergence | None = None
    queries: Queries | None = None
    discretisation: Discretisation = Discretisation()
    sign_test: dict[Label, dict[Label, Number | bool | Text | None]] | None = None


class _Camouflage(Struct, frozen=True):
    record: AttackRecord | None = None


class _Signs(Struct, frozen=True):
    texture: dict[Label, Number | bool | None]
    shape: dict[Label, Number | bool | None]
    total: Number


class Practicality(Struct, frozen=True):
    """One row of `practicality.json`: what a camouflage asks of those who would make it.

    Attributes:
        name: the camouflage's.
        score: the signs of texture and shape, and their total.
        texture, shape: measured quantities; None for a side left alone.
    """

    name: Name
    score: _Signs
    texture: dict[Label, Number | bool | None] | None = None
    shape: dict[Label, Number | bool | None] | None = None


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


def read_config(path: Path) -> RunConfig:
    """Reads a run's `config.json`; all defaults where it is missing.

    Raises:
        StoredFileError: the file is of another form.
    """
    if not path.exists():
        return RunConfig()
    every: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
    config: RunConfig = check_document(every, RunConfig, str(path), _REMEDY)
    return RunConfig(config.title, config.seed, config.imagery, every)


def read_environment(path: Path) -> Mapping[str, Any]:
    """Reads what `environment.json` says of the machine and the versions; empty where missing.

    Raises:
        StoredFileError: the file is of another form.
    """
    if not path.exists():
        return {}
    every: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
    check_document(every, _Commands, str(path), _REMEDY)
    known: Any = dict[Label, Text | int | float | bool | list[Text] | None]
    return check_document(every, known, str(path), _REMEDY)


def read_timings(path: Path) -> list[Timing]:
    """Reads how long the steps of a run took; empty where missing.

    Raises:
        StoredFileError: the file is of another form.
    """
    return read_document(path, list[Timing], _REMEDY) if path.exists() else []


def read_detectors(folder: Path) -> dict[str, DetectorCard]:
    """Reads what is recorded of the detectors of a run, by folder.

    Raises:
        StoredFileError: a file is of another form.
    """
    return {
        path.parent.name: read_card(path.parent) for path in sorted(folder.glob("*/detector.json"))
    }


def read_records(folder: Path) -> dict[str, AttackRecord]:
    """Reads what was recorded while the camouflages of a run were made, by folder.

    Raises:
        StoredFileError: a file is of another form.
    """
    return {
        path.parent.name: read_document(path, _Camouflage, _REMEDY).record or AttackRecord()
        for path in sorted(folder.glob("*/camouflage.json"))
    }


def read_sources(path: Path) -> list[str]:
    """Reads what the tiles of a background set were cut from, from its `index.json`.

    Raises:
        StoredFileError: the file is of another form.
    """
    index: _Index = read_document(path, _Index, _REMEDY)
    return [tile.source for tile in index.tiles]


def read_log(path: Path) -> list[LogRow]:
    """Reads the log of a training or an attack.

    Raises:
        StoredFileError: the file is of another form.
    """
    rows: list[LogRow] = read_lines(path, LogRow, _REMEDY)
    for row in rows:
        if row.kind != "validation" and row.loss is None and row.losses is None:
            raise StoredFileError(f"{path} has a row without a loss; {_REMEDY}.")
    return rows
