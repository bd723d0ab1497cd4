"""One resumable loop for trainings and attacks, whose checkpoints survive a kill."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from skyproof.documents import check_document, read_lines
from skyproof.errors import NotFiniteError, RunFolderError, StoredFileError
from skyproof.files import refuse_foreign, refuse_links, to_json, write_jsonl
from skyproof.ranges import WholeNumber
from skyproof.storage import read_tensors, write_tensors

CHECKPOINT = "checkpoint.safetensors"
_ROWS = "steps.jsonl"


@runtime_checkable
class LoopPart(Protocol):
    """An object that changes from step to step: a module, an optimiser, a schedule."""

    def state_dict(self) -> dict[str, Any]:
        """Returns the changing state: nested dictionaries of tensors and plain values."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Restores a result of `state_dict`."""


@dataclass
class Loop:
    """The steps of a run in a folder: `for step in loop` yields 1, 2, ... up to the last.

    `resume` first returns to the last checkpoint, so that a stopped run continues. The body of the
    loop must depend on the step's number and on `parts` alone. A checkpoint is one file with the
    parts, the step, the identity and the facts, written before the first step, after every
    `checkpoint_every` steps and after the last.

    Attributes:
        identity: JSON values; a folder with another identity is refused.
        other: words in errors for a run of another identity.
        remedy: advice in errors about a damaged checkpoint.
        on_row: called with each row of `steps.jsonl` after its step.
        facts: JSON values that are decided once, before the first step.
        step: number of the current step, or of the last finished one; 0 at the start.
    """

    folder: Path
    identity: Mapping[str, Any]
    steps: int
    checkpoint_every: int
    parts: Mapping[str, LoopPart]
    other: str
    remedy: str
    on_row: Callable[[dict[str, Any]], None] | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    step: int = 0
    rows: list[dict[str, Any]] = field(default_factory=list)
    _clock: float = 0.0

    def resume(self) -> None:
        """Returns to the last checkpoint, if there is one."""
        path = self.folder / CHECKPOINT
        refuse_links(self.folder)
        if not path.exists():
            refuse_foreign(self.folder, {_ROWS})
            return
        tensors, content = read_tensors(path, self.remedy)
        refuse_other(self.folder, content.get("identity"), self.identity, self.other)
        record: _Record = check_document(content, _Record, f"{path} has a record that", self.remedy)
        if record.digest != _digest(content, tensors):
            raise StoredFileError(f"{path} is not as it was written; {self.remedy}.")
        if record.step > self.steps:
            raise StoredFileError(
                f"{path} is of step {record.step}, but the last is {self.steps}; {self.remedy}."
            )
        try:
            for name, part in self.parts.items():
                part.load_state_dict(_joined(name, tensors, record.plain))
        except Exception as error:
            # A library may raise anything for values that are not its own.
            raise StoredFileError(f"{path} does not fit this run; {self.remedy}.") from error
        self.facts = record.facts
        self.step = record.step
        written = self.folder / _ROWS
        rows: list[dict[str, Any]] = read_lines(written, dict[str, Any], self.remedy)
        for row in rows:
            check_document(row.get("step"), WholeNumber, f"{written}, step", self.remedy)
        # A kill may have left rows of later steps.
        self.rows = [row for row in rows if row["step"] <= self.step]

    def __iter__(self) -> Iterator[int]:
        """Yields the numbers of the remaining steps; a part that is not finite stops the loop."""
        if self.step == 0:
            # The first checkpoint marks the folder as ours before the body writes any file.
            self._store()
        while self.step < self.steps:
            done = len(self.rows)
            self.step += 1
            self._clock = time.perf_counter()
            yield self.step
            if self.step % self.checkpoint_every == 0 or self.step == self.steps:
                self._store()
            for row in self.rows[done:]:
                if self.on_row is not None:
                    self.on_row(row)

    def report(self, row: Mapping[str, Any]) -> None:
        """Adds a row to `steps.jsonl`, with the seconds since the last one or the step's start."""
        now = time.perf_counter()
        self.rows.append({**row, "seconds": round(now - self._clock, 4)})
        self._clock = now

    def forget(self) -> None:
        """Removes the checkpoint, once the result is stored."""
        (self.folder / CHECKPOINT).unlink(missing_ok=True)

    def _store(self) -> None:
        """Writes the rows and then the checkpoint, whose step says which rows count."""
        tensors: dict[str, Tensor] = {}
        plain: dict[str, Any] = {}
        for name, part in self.parts.items():
            _split(name, part.state_dict(), tensors, plain)
        record = {"identity": self.identity, "step": self.step, "facts": self.facts, "plain": plain}
        path = self.folder / CHECKPOINT
        try:
            # The form that will be read: JSON turns tuples into lists.
            content = json.loads(to_json(path, record))
            write_jsonl(self.folder / _ROWS, self.rows)
            write_tensors(path, tensors, {**content, "digest": _digest(content, tensors)})
        except NotFiniteError as error:
            raise NotFiniteError(
                f"What step {self.step} left in {path} would not be finite, so the last checkpoint "
                "stays; begin again in another folder, with a lower learning rate."
            ) from error


@dataclass(frozen=True)
class _Record:
    """The plain values of a checkpoint, with a digest of all else."""

    identity: Any
    step: WholeNumber
    facts: dict[str, Any]
    plain: dict[str, Any]
    digest: str


def _digest(record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """The SHA-256 over a record and the kinds of its tensors, so that optimisers know their own."""
    kinds = {name: [str(value.dtype), list(value.shape)] for name, value in tensors.items()}
    content = [{name: value for name, value in record.items() if name != "digest"}, kinds]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def refuse_other(folder: Path, stored: Any, wanted: Mapping[str, Any], other: str) -> None:
    """Refuses a folder with another stored identity; `other` names its run in the error."""
    if stored != json.loads(json.dumps(wanted)):
        raise RunFolderError(
            f"{folder} holds {other}; choose another --out, or move it away first."
        )


def _split(path: str, value: Any, tensors: dict[str, Tensor], plain: dict[str, Any]) -> None:
    """Sorts the leaves of nested dictionaries into tensors and plain values, by their path."""
    if isinstance(value, Mapping) and value:
        for key, below in value.items():
            # Optimisers number their parameters; JSON would turn the numbers into text.
            _split(f"{path}/{'#' if isinstance(key, int) else ''}{key}", below, tensors, plain)
    elif isinstance(value, Tensor):
        tensors[path] = value
    else:
        plain[path] = value


def _joined(name: str, tensors: Mapping[str, Tensor], plain: Mapping[str, Any]) -> dict[str, Any]:
    """Rebuilds the nested dictionaries of one part."""
    state: dict[str, Any] = {}
    for path, value in (*plain.items(), *tensors.items()):
        part, *texts = path.split("/")
        if part != name or not texts:
            continue
        *above, last = (int(text[1:]) if text.startswith("#") else text for text in texts)
        branch: dict[Any, Any] = state
        for key in above:
            branch = branch.setdefault(key, {})
        branch[last] = value
    return state
