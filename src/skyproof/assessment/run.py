"""A run folder and its steps: each is done once, and kept when the same run is repeated."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import asdict, replace

from skyproof.assessment.environment import note_end, write_environment
from skyproof.console import duration, say
from skyproof.documents import read_document
from skyproof.errors import RunFolderError
from skyproof.files import Hold, alone, is_leftover, refuse_links, write_json
from skyproof.layout import Layout
from skyproof.results.stored import Timing, read_environment, read_timings

# Every run's config names one of them, and a seed.
_RECIPES = {"suite", "preset"}

# Estimated seconds on one core: to start a step, per vehicle, per random control, and per million
# pixels (of detection and attacks: for one small detector).
START_S = 5.0
VEHICLE_S = 0.08
CONTROL_S = 0.1
GROUND_S = 2.6
RENDER_S = {"torch": 0.7, "cycles": 30.0}
DETECT_S = 0.4
ATTACK_S = 2.7

SOURCES = "sources_sha256"
"""Where a run's config keeps the digests of the user's files, by path."""

# Weight of the estimates: measured seconds count for more once they exceed this.
_TRUSTED_S = 60.0

# Where something is computed does not change its results.
_PLACE = ("device", "blender", "workers")


class RunEnded(Exception):
    """Raised by a step that makes the steps after it pointless; the run ends without an error."""


@dataclass(frozen=True)
class Step:
    """One thing that a run does once; its outputs exist when it is finished.

    Attributes:
        kind: kind of work, such as "train"; it groups steps in tables of times.
        name: object of the work; kind and name together are unique in a run.
        settings: plain values, paths and dataclasses that decide the outputs, in addition to the
            settings of earlier steps.
        growing: whether a stopped step leaves half-filled folders from which it resumes; otherwise
            an output appears whole or not at all.
        renewed: whether changed settings or newer inputs repeat the step. Other steps are kept.
        extra: whether the same run may be repeated without this step.
        words: title for people in place of kind and name, which run folders keep.
        effort_s: estimated seconds on one core; only the share of the whole counts.
    """

    kind: str
    name: str
    outputs: tuple[Path, ...]
    # Functions are not compared, because settings tell two steps apart.
    work: Callable[[], object] = field(compare=False)
    settings: object = None
    inputs: tuple[Path, ...] = ()
    growing: bool = False
    renewed: bool = False
    extra: bool = False
    effort_s: float = START_S
    words: str = ""

    @property
    def id(self) -> str:
        """Kind and name, such as "train/retinanet"."""
        return f"{self.kind}/{self.name}"

    @property
    def title(self) -> str:
        """Kind and name for people: "train retinanet", "ground"."""
        return self.words or (self.kind if self.kind == self.name else f"{self.kind} {self.name}")

    @property
    def places(self) -> list[Path]:
        """Where a stopped step leaves files from which it resumes."""
        return [output.parent if self.growing else output for output in self.outputs]

    def is_finished(self) -> bool:
        """Whether its outputs exist, and are new enough if the step is renewed."""
        if not all(output.exists() for output in self.outputs):
            return False
        if not self.renewed:
            return True
        oldest = min(output.stat().st_mtime_ns for output in self.outputs)
        return all(path.stat().st_mtime_ns <= oldest for path in self.inputs if path.exists())


class _Kept(msgspec.Struct, frozen=True):
    """The record of a step in `steps.json`: the digest of its settings, and its places."""

    settings_sha256: str
    places: list[str] = []
    extra: bool = False


class Run:
    """A new run, or the same run again; nothing is written before `begun`.

    A run may be repeated with other settings if no finished step depends on them, so that a
    late mistake can be corrected. `config` is everything that decides the results, as plain JSON
    values. A folder that holds another run or something else is refused.
    """

    def __init__(self, folder: Path, config: Mapping[str, Any], steps: Sequence[Step]) -> None:
        self.folder = Path(folder)
        self.steps = tuple(steps)
        self._layout = Layout(self.folder)
        self._config: dict[str, Any] = json.loads(json.dumps(config, default=str))
        self._digests = {step.id: self._digest(step) for step in self.steps}
        self._refuse_another()

    @contextmanager
    def begun(self, device: str) -> Iterator[Hold]:
        """Locks the folder, and notes the request, the machine and the end."""
        with alone(self.folder) as hold:
            # Another process may have begun meanwhile.
            stored = self._refuse_another()
            if stored != self._config:
                write_json(self._layout.config, self._config)
            self._keep(step for step in self.steps if not step.renewed)
            # A finished run keeps the version and the time of its end.
            ended = "finished" in read_environment(self._layout.environment)
            ended = ended and all(map(self.is_finished, self.steps))
            if not ended:
                write_environment(self._layout.environment, device, self._config.get("seed"))
            yield hold
            if not ended:
                note_end(self._layout.environment)

    def do(self) -> None:
        """Runs every unfinished step, and estimates the time left.

        Raises RunEnded if a step ends the run early.
        """
        for number, step in enumerate(self.steps, 1):
            if self.is_finished(step):
                continue
            finished = {before.id for before in self.steps if self.is_finished(before)}
            times = read_timings(self._layout.timings)
            seconds = {f"{row.stage}/{row.name or ''}": row.seconds for row in times}
            left_s = time_left_s(self.steps, {key: seconds[key] for key in finished & {*seconds}})
            about = "" if left_s is None else f" (about {duration(left_s)} left)"
            say(f"[{number}/{len(self.steps)}] {step.title}{about}")
            self._timed(step)
            if step.renewed:
                self._keep([step])

    def is_finished(self, step: Step) -> bool:
        """Whether a step is finished; a renewed step must have been run with the same settings."""
        if not step.is_finished():
            return False
        kept = self._kept().get(step.id) if step.renewed else None
        return kept is None or kept.settings_sha256 == self._digests[step.id]

    def note_times(self, rows: Iterable[Timing]) -> None:
        """Writes the times of steps that other processes ran."""
        write_json(self._layout.timings, [asdict(row) for row in rows])

    def _refuse_another(self) -> dict[str, Any] | None:
        """Refuses a folder of another run; returns the stored config."""
        if not self.folder.exists():
            return None
        if not self.folder.is_dir():
            raise RunFolderError(f"{self.folder} is a file; choose another --out.")
        refuse_links(self.folder)
        layout = self._layout
        entries = {entry.name for entry in self.folder.iterdir() if not is_leftover(entry)}
        if layout.config.name not in entries:
            if entries:
                raise RunFolderError(
                    f"{self.folder} is not empty and not a run of skyproof; choose another --out."
                )
            return None
        stored: dict[str, Any] = read_document(
            layout.config, dict[str, Any], "choose another --out"
        )
        records = {path.name for path in (layout.config, layout.environment, layout.timings)}
        if stored == self._config or entries <= {*records, layout.steps.name}:
            return stored
        if layout.steps.name not in entries and not (_RECIPES & {*stored} and "seed" in stored):
            raise RunFolderError(
                f"{self.folder} has a config.json and is not a run of skyproof; choose another "
                "--out."
            )
        if self._changes_what_is_begun():
            before, after = stored.get(SOURCES), self._config.get(SOURCES)
            if isinstance(before, dict) and isinstance(after, dict):
                both = sorted({*before} & {*after})
                replaced = [path for path in both if before[path] != after[path]]
                if replaced:
                    raise RunFolderError(
                        f"{self.folder} holds a run whose finished steps read other content of "
                        f"{', '.join(replaced)[:300]}; choose another --out, or put back what they "
                        "read."
                    )
            names = {*stored, *self._config}
            changed = sorted(key for key in names if stored.get(key) != self._config.get(key))
            raise RunFolderError(
                f"{self.folder} holds a run with other settings ({', '.join(changed)[:300]}) that "
                "finished steps depend on; choose another --out, or remove the folder to start "
                "afresh."
            )
        return stored

    def _changes_what_is_begun(self) -> bool:
        """Whether a begun step had other settings, or is no step of this run."""
        known = self._kept()
        kept_steps = (step for step in self.steps if not step.renewed)
        begun = {step.id for step in kept_steps if any(map(Path.exists, step.places))}
        if not known:
            return bool(begun)
        changed = any(
            name in known and known[name].settings_sha256 != self._digests[name] for name in begun
        )
        return changed or any(
            not kept.extra and any((self.folder / place).exists() for place in kept.places)
            for name, kept in known.items()
            if name not in self._digests
        )

    def _kept(self) -> dict[str, _Kept]:
        place = self._layout.steps
        if not place.exists():
            return {}
        return read_document(place, dict[str, _Kept], "choose another --out")

    def _keep(self, steps: Iterator[Step] | Sequence[Step]) -> None:
        """Adds steps to `steps.json`; earlier ones stay in it."""
        known = self._kept()
        now = {
            step.id: _Kept(
                self._digests[step.id],
                # A renewed step is repeated after any change.
                [] if step.renewed else [self._relative(place) for place in step.places],
                step.extra,
            )
            for step in steps
        }
        if any(known.get(name) != kept for name, kept in now.items()):
            write_json(self._layout.steps, msgspec.to_builtins({**known, **now}))

    def _digest(self, step: Step) -> str:
        text = json.dumps(self._plain(step.settings), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def _plain(self, value: object) -> object:
        """Settings as JSON values; the run folder may be moved or renamed."""
        if is_dataclass(value):
            return {
                field.name: self._plain(getattr(value, field.name))
                for field in fields(value)
                if field.name not in _PLACE
            }
        if isinstance(value, Mapping):
            return {str(key): self._plain(each) for key, each in value.items()}
        if isinstance(value, tuple | list):
            return [self._plain(each) for each in value]
        if isinstance(value, Path | str):
            return self._relative(value)
        return value

    def _relative(self, value: Path | str) -> str:
        return str(value).replace(f"{self.folder}{os.sep}", "")

    def _timed(self, step: Step) -> None:
        """Runs a step, and stores its time."""
        started = time.monotonic()
        try:
            step.work()
        except BaseException:
            # A stopped step resumes from its checkpoint, so its time counts too. An error in
            # storing it must not hide the reason for the stop.
            with suppress(RunFolderError):
                self._add_time(step, time.monotonic() - started)
            raise
        self._add_time(step, time.monotonic() - started)

    def _add_time(self, step: Step, seconds: float) -> None:
        rows = {(row.stage, row.name): row for row in read_timings(self._layout.timings)}
        row = rows.get((step.kind, step.name), Timing(stage=step.kind, name=step.name, seconds=0.0))
        rows[row.stage, row.name] = replace(row, seconds=round(row.seconds + seconds, 2))
        write_json(self._layout.timings, msgspec.to_builtins([*rows.values()]))


def time_left_s(
    steps: Sequence[Step], seconds: Mapping[str, float], cores: int = 1
) -> float | None:
    """Estimates the seconds left from those of finished steps by id; None before one finishes."""
    done = [step for step in steps if step.id in seconds]
    if not done:
        return None
    took_s = sum(seconds[step.id] for step in done)
    speed = (_TRUSTED_S + took_s) / (_TRUSTED_S + sum(step.effort_s for step in done))
    rest_s = sum(step.effort_s for step in steps if step.id not in seconds)
    return speed * rest_s / cores


def precheck_images(scenes: int, draws: int) -> int:
    """Images of a precheck: scenes as built, in 62 paints, 4 blurs, 4 suns and 10 controls."""
    return scenes * (1 + 62 + 4 + 4 + 10 * draws)
