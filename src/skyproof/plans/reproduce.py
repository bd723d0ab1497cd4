"""`skyproof reproduce`: the paper's tables and its figure, as a Snakemake workflow."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cycles.blender import find_blender
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import read_json
from skyproof.plans.demo import check_detectors
from skyproof.plans.plan import SNAKEFILE, Plan, Preset, read_preset
from skyproof.plans.progress import (
    FinishedJob,
    failed_log,
    finished_jobs,
    time_left_s,
    write_timings,
)
from skyproof.plans.run_folder import RunFolder

__all__ = ["Reproduce"]

_POLL_S = 1.0
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Reproduce:
    """Runs every attack of the paper with its controls, and sets the numbers beside the paper's.

    Ends in tables/README.md: both tables and the figure of EASR against practicality. Stop it whenever you like and
    give the same command again: finished jobs are kept, training and attacks go on from their last checkpoint.

    On a cluster: give --dry-run, which prints the plain snakemake command; add its options for your executor, such
    as --executor slurm --jobs 50. Every job says what memory, time and GPU it asks for.

    Attributes:
        preset: quick (slim detectors, for 2 CPU cores), paper (full size, for one GPU), or a JSON file like theirs.
        out: run folder.
        cores: CPU cores to use; all where not given.
        device: auto, cpu or cuda.
        cycles: also score finished attacks and random controls as Blender's path tracer Cycles draws them, the paper's
            "Blender" column. A finished run may be given again with it: only that column is added then.
        blender: for --cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not given, what
            `make blender` made, then `blender` on the PATH.
        dry_run: only check, and say what would be done and how.
    """

    preset: str = "quick"
    out: Path = Path("runs/reproduce")
    cores: int | None = None
    device: str = "auto"
    cycles: bool = False
    blender: Path | None = None
    dry_run: bool = False

    def run(self) -> None:
        """Runs what is not finished yet."""
        name, path = read_preset(self.preset)
        settings = read_json(path)
        preset = Preset.parse(settings)
        if find_spec("snakemake") is None:
            raise ConfigurationError(
                "skyproof reproduce needs Snakemake; run pip install 'skyproof[reproduce]' first."
            )
        cores = len(os.sched_getaffinity(0)) if self.cores is None else self.cores
        if cores < 1:
            raise ConfigurationError(f"--cores expects at least 1, got {self.cores}.")
        choose_device(self.device)
        check_detectors(preset.detectors, preset.size)
        cycles = self._cycles()
        run = RunFolder(self.out, {"preset": name, **settings})
        plan = Plan(preset, cycles=self.cycles)
        if self.dry_run:
            self._check(path, plan, cycles)
            return
        with _alone(self.out) as lock:
            run.start(self.device)
            more = ["--config", f"device={self.device}", *cycles]
            command = _snakemake(self.out, self.out / "config.json", *more)
            # Marks left by a kill must not stop the next try; our own lock keeps a second run away.
            command += [
                "--cores",
                str(cores),
                "--rerun-incomplete",
                "--nolock",
                "--scheduler",
                "greedy",
            ]
            if preset.resources.get("gpu"):
                command += ["--resources", "gpu=1"]
            say(
                f"skyproof reproduce, preset {name}: {_listed(plan.jobs)}; {cores} cores, run folder {self.out}"
            )
            _follow(command, self.out, plan.jobs, cores, lock)
            run.finish()
        say(f"Tables: {(self.out / 'tables' / 'README.md').resolve()}")

    def _cycles(self) -> list[str]:
        """What the workflow is told of the Cycles column, which like the device is no setting of the run folder.

        Raises:
            ConfigurationError: there is no usable Blender, or it is given for nothing.
        """
        if not self.cycles:
            if self.blender is not None:
                raise ConfigurationError(
                    "--blender is for the Cycles column; give --cycles too, or leave it out."
                )
            return []
        # Not resolved: the Python of a virtual environment is a link, and loses its packages when followed.
        return ["cycles=1", f"blender={find_blender(self.blender).path.absolute()}"]

    def _check(self, path: Path, plan: Plan, cycles: Sequence[str]) -> None:
        more = ["--config", *cycles] if cycles else []
        with tempfile.TemporaryDirectory() as empty:
            place = self.out if self.out.exists() else Path(empty)
            done = subprocess.run(
                [
                    *_snakemake(place, path, *more),
                    "--cores",
                    "1",
                    "--dry-run",
                    "--nolock",
                    "--quiet",
                    "all",
                ],
                capture_output=True,
                text=True,
            )
        if done.returncode:
            raise ConfigurationError(
                f"Snakemake refuses this plan: {' '.join(done.stderr.split())[-400:]}"
            )
        say(f"Jobs: {_listed(plan.jobs)}.")
        say("By hand, or with options for a cluster's executor:")
        say("  " + shlex.join(_snakemake(self.out, path, *more)) + " --cores 2")


def _listed(jobs: Mapping[str, int]) -> str:
    return f"{sum(jobs.values())} jobs ({', '.join(f'{rule} {count}' for rule, count in jobs.items())})"


def _snakemake(out: Path, config: Path, *more: str) -> list[str]:
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--snakefile",
        str(SNAKEFILE),
        "--directory",
        str(out.resolve()),
    ]
    command += ["--configfile", str(config.resolve()), *more]
    # A newer version of the package does not throw away what an older one took hours for.
    return [*command, "--rerun-triggers", "mtime"]


@contextmanager
def _alone(out: Path) -> Iterator[int]:
    """Holds the folder's lock; a kill gives it back."""
    # Windows has none, and must still run the other commands.
    import fcntl

    out.mkdir(parents=True, exist_ok=True)
    with open(out / ".lock", "w", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunFolderError(
                f"Another run is working in {out}; wait for it, or choose another --out."
            ) from error
        yield file.fileno()


def _follow(
    command: Sequence[str], out: Path, jobs: Mapping[str, int], cores: int, lock: int
) -> None:
    """Runs Snakemake and prints a line per finished job."""
    place = out / "snakemake.log"
    before = set(_finished(out, jobs))
    if before:
        say(f"  {len(before)} jobs were finished before")
    with open(place, "ab") as log, _stop_signals():
        start = log.tell()
        # In a session of its own, so that Ctrl-C reaches it once, through us; it holds the lock as long as it lives.
        child = subprocess.Popen(
            command, stdout=log, stderr=log, start_new_session=True, pass_fds=[lock]
        )
        try:
            while child.poll() is None:
                time.sleep(_POLL_S)
                before = _say_finished(out, jobs, cores, before)
        except BaseException:
            _end(child)
            raise
        finally:
            write_timings(out / "timings.csv", finished_jobs(out))
    _say_finished(out, jobs, cores, before)
    if child.returncode:
        raise RunFolderError(_failure(out, place.read_bytes()[start:].decode(errors="replace")))


def _say_finished(
    out: Path, jobs: Mapping[str, int], cores: int, before: set[FinishedJob]
) -> set[FinishedJob]:
    """Says what is new; a job that was done again counts as new, as it took another time."""
    finished = _finished(out, jobs)
    left_s = time_left_s(jobs, finished, cores)
    for number, job in enumerate(finished, start=1):
        if job not in before:
            what = job.rule if job.rule == job.name else f"{job.rule} {job.name}"
            left = "" if left_s is None else f", about {_duration(left_s)} left"
            say(f"  {what}: {job.seconds:.0f} s ({number} of {sum(jobs.values())} jobs{left})")
    return set(finished)


def _finished(out: Path, jobs: Mapping[str, int]) -> list[FinishedJob]:
    """Those of the plan: an earlier run may have added the Cycles column."""
    return [job for job in finished_jobs(out) if job.rule in jobs]


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{seconds / 3600:.1f} h"


def _failure(out: Path, text: str) -> str:
    log = failed_log(text)
    if log is None:
        return f"Snakemake stopped; see {out / 'snakemake.log'}, then give the same command again to go on."
    path = out / log
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n") if path.exists() else []
    last = next(
        (line.removeprefix("skyproof: ") for line in reversed(lines) if line.strip()),
        "it printed nothing",
    )
    return f"A job failed ({last.strip()}); see {path}, then give the same command again to go on."


def _end(child: subprocess.Popen[Any]) -> None:
    """Ends Snakemake and its jobs, politely at first."""
    for number in (signal.SIGINT, signal.SIGKILL):
        try:
            os.killpg(child.pid, number)
            child.wait(_PATIENCE_S)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            continue


@contextmanager
def _stop_signals() -> Iterator[None]:
    """Within, being terminated or losing the terminal ends the run as Ctrl-C does."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    kept = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
