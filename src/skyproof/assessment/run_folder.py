"""A run folder tells what was asked and on what machine.

It also tells how long the steps took.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from skyproof import __version__
from skyproof.assessment.plan import Plan, Step
from skyproof.assessment.sources import read_otherwise
from skyproof.documents import read_document
from skyproof.errors import RunFolderError, SkyproofError
from skyproof.files import is_leftover, write_json
from skyproof.layout import Layout
from skyproof.results.stored import read_environment, read_timings

_REMEDY = "move it away and give the same command again"

_LONGEST_COMMAND = 2000
"""A shell may have put hundreds of photographs into it."""


@dataclass(frozen=True)
class FinishedJob:
    """One step that is done.

    Attributes:
        kind, name: the step's.
        seconds: what its last run took.
        largest_memory_mb: the most memory it held; None where it was not measured.
    """

    kind: str
    name: str
    seconds: float
    largest_memory_mb: float | None = None

    @property
    def id(self) -> str:
        """The step's."""
        return f"{self.kind}/{self.name}"


class RunFolder:
    """A new run, or the same run again; nothing is written before `start`.

    A run may be given other settings as long as they change nothing of its finished steps: a
    mistake that shows late is corrected, and what was made before it is kept.

    Args:
        path: the folder; made if missing.
        config: everything that decides the results, as plain JSON values.
        plan: the steps that it stands for.
        plan_of: gives the steps that another config stands for.

    Raises:
        RunFolderError: the folder holds another run or something else.
        StoredFileError: the folder's `config.json` is damaged.
    """

    def __init__(
        self,
        path: Path,
        config: dict[str, Any],
        plan: Plan,
        plan_of: Callable[[dict[str, Any]], Plan],
    ) -> None:
        self.path = Path(path)
        self._layout = Layout(self.path)
        self._plan = plan
        self._had_ended = False
        self._config = json.loads(json.dumps(config, default=str))
        self._stored: dict[str, Any] | None = None
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise RunFolderError(f"{self.path} is a file; choose another --out.")
        entries = {entry.name for entry in self.path.iterdir() if not is_leftover(entry)}
        place = self._layout.config
        if place.name not in entries:
            if entries:
                raise RunFolderError(
                    f"{self.path} is not empty and not a run of skyproof; choose another --out."
                )
            return
        stored: dict[str, Any] = read_document(place, dict[str, Any], "choose another --out")
        self._stored = stored
        records = {place.name, self._layout.environment.name, self._layout.timings.name}
        if stored == self._config or entries <= records:
            return
        if replaced := read_otherwise(stored, self._config, plan):
            raise RunFolderError(
                f"{self.path} holds a run whose finished steps read other content of "
                f"{', '.join(replaced)[:300]}; choose another --out, or put back what they read."
            )
        if not _same_where_finished(stored, plan, plan_of):
            names = {*stored, *self._config}
            changed = sorted(key for key in names if stored.get(key) != self._config.get(key))
            raise RunFolderError(
                f"{self.path} holds a run with other settings ({', '.join(changed)[:300]}) that "
                "finished steps depend on; choose another --out, or remove the folder to start "
                "afresh."
            )

    def start(self, device: str) -> None:
        """Notes what was asked, and on what machine, unless the run has ended already.

        Raises:
            RunFolderError: the folder cannot be written.
        """
        if self._stored != self._config:
            write_json(self._layout.config, self._config)
        noted = "finished" in read_environment(self._layout.environment)
        self._had_ended = noted and all(step.is_finished() for step in self._plan.steps)
        # What nothing is left to do of was made by the version and until the time that it tells.
        if not self._had_ended:
            self._record_environment(device, self._config.get("seed"))

    def timed(self, step: Step, work: Callable[[], object]) -> None:
        """Does a step's work, and keeps the time it took."""
        started = time.monotonic()
        try:
            work()
        except BaseException:
            # A stopped step's time counts too: it goes on later from its checkpoint. Why it stopped
            # matters more.
            with suppress(RunFolderError):
                self._add_time(step, time.monotonic() - started)
            raise
        self._add_time(step, time.monotonic() - started)

    def seconds(self) -> dict[str, float]:
        """Returns by step id how long steps took so far, stopped ones included."""
        return {f"{row['stage']}/{row.get('name', '')}": row["seconds"] for row in self._times()}

    def note_times(self, jobs: Iterable[FinishedJob]) -> None:
        """Writes the times of steps that others did."""
        rows = [
            {
                "stage": job.kind,
                "name": job.name,
                "seconds": round(job.seconds, 2),
                "largest_memory_mb": job.largest_memory_mb,
            }
            for job in jobs
        ]
        write_json(self._layout.timings, rows)

    def finish(self) -> None:
        """Notes when the run ended, once."""
        if self._had_ended:
            return
        path = self._layout.environment
        stored: dict[str, Any] = read_document(path, dict[str, Any], _REMEDY)
        write_json(path, {**stored, "finished": _now()})

    def _times(self) -> list[dict[str, Any]]:
        times = read_timings(self._layout.timings)
        return [
            {name: value for name, value in asdict(row).items() if value is not None}
            for row in times
        ]

    def _add_time(self, step: Step, seconds: float) -> None:
        rows = self._times()
        known = [row for row in rows if (row["stage"], row.get("name")) == (step.kind, step.name)]
        if not known:
            known = [{"stage": step.kind, "name": step.name, "seconds": 0.0}]
            rows += known
        known[0]["seconds"] = round(known[0]["seconds"] + seconds, 2)
        write_json(self._layout.timings, rows)

    def _record_environment(self, device: str, seed: Any) -> None:
        path = self._layout.environment
        stored = read_environment(path)
        command = " ".join(["skyproof", *sys.argv[1:]])
        if len(command) > _LONGEST_COMMAND:
            command = f"{command[:_LONGEST_COMMAND]} …"
        commands = [*stored.get("commands", []), command]
        record = {
            "skyproof": __version__,
            "commit": _commit(),
            "python": platform.python_version(),
            **{
                name: _version(name)
                for name in ("torch", "torchvision", "ultralytics", "numpy", "rasterio")
            },
            "platform": platform.platform(),
            "cpu": _cpu_name(),
            "cores": os.cpu_count(),
            "device": device,
            "seed": seed,
            "started": stored.get("started", _now()),
            "commands": list(dict.fromkeys(commands)),
        }
        write_json(path, record)


def _same_where_finished(
    stored: dict[str, Any], plan: Plan, plan_of: Callable[[dict[str, Any]], Plan]
) -> bool:
    """Says whether a plan leaves everything as it is that a stored one has finished or begun."""
    try:
        before = plan_of(stored)
    except SkyproofError:
        # Settings that this version does not understand.
        return False
    # What is renewed is made again where anything changes.
    made = {step.id: step.command for step in before.steps if step.is_begun() and not step.renewed}
    after = {step.id: step.command for step in plan.steps}
    return all(after.get(name) == command for name, command in made.items())


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Returns the commit of a source checkout.

    It is None for an installed package, even for one inside a user's own checkout.
    """
    here = Path(__file__).resolve().parents[3]
    if not (here / ".git").exists():
        return None
    try:
        answer = subprocess.run(
            ["git", "-C", str(here), "rev-parse", "--short", "HEAD"],
            capture_output=True,
            text=True,
            timeout=5,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
