"""Runs a plan with Snakemake on several cores of this machine, and prints its progress."""

import csv
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from skyproof.assessment.run import Run, Step, time_left_s
from skyproof.console import duration, say
from skyproof.errors import RunFolderError
from skyproof.files import Hold
from skyproof.reproduction.plan import Plan
from skyproof.results.stored import Timing

SNAKEFILE = Path(__file__).with_name("Snakefile")

_POLL_S = 1.0

_FAILED = re.compile(
    r"^Error in rule [^\n]*:\n(?:(?!\[|Error in )[^\n]*\n)*?    log: (?P<log>[^\n]+?) \(check log",
    re.MULTILINE,
)

# Largest benchmark file, in characters, and number in it; Snakemake writes none above.
_LONGEST = 10_000
_LARGEST = 1e9


def shell_line(step: Step, config: Mapping[str, Any]) -> Callable[[object], str]:
    """Returns a step's quoted shell line, as a function: Snakemake takes braces for wildcards."""
    words = [sys.executable, "-m", "skyproof.reproduction", "step", step.id]
    line = shlex.join([*words, *(f"--{name}={value}" for name, value in config.items())])
    return lambda wildcards: line


def output_of(
    step: Step, directory: Callable[[str], Any], update: Callable[[str], Any]
) -> list[Any]:
    """Returns a step's outputs; `update` marks what Snakemake keeps of a stopped job."""
    paths = [str(path) for path in step.outputs]
    # The report is renewed: it replaces its own pages alone, and knows them by the old ones.
    if step.growing or step.renewed:
        return [update(path) for path in paths]
    return [path if Path(path).suffix else directory(path) for path in paths]


def snakemake_words(folder: Path, blender: Path | None, device: str | None = None) -> list[str]:
    """Returns the command line that starts Snakemake on a run folder, but for its executor."""
    words = [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE)]
    words += ["--directory", str(folder.resolve())]
    config = {"device": device, "blender": blender}
    told = [f"{name}={value}" for name, value in config.items() if value is not None]
    words += ["--config", *told] if told else []
    # A newer version of the package does not throw away what an older one took hours for.
    return [*words, "--rerun-triggers", "mtime"]


def run_side_by_side(plan: Plan, run: Run, command: Sequence[str], cores: int, hold: Hold) -> None:
    """Runs Snakemake on a plan, and prints a line per finished step; `cores` run side by side.

    Snakemake holds the run folder's lock as long as it lives, and ends with this process, however
    that ends (`skyproof.reproduction.watched`).
    """
    place = run.folder / "snakemake.log"
    known = {step.id for step in plan.steps}
    before = finished_jobs(run.folder)
    # An earlier call may have had more steps.
    if known & {*before}:
        say(f"  {len(known & {*before})} steps were finished before")
    with open(place, "ab") as log, _stop_signals():
        start = log.tell()
        # The other end of the pipe is held by this process alone.
        read_end, write_end = os.pipe()
        words = [sys.executable, "-m", "skyproof.reproduction.watched", str(read_end)]
        words += [str(hold.descriptor), *command]
        # Marks left by a kill must not stop the next try; our own lock keeps a second run away.
        words += ["--rerun-incomplete", "--nolock", "--scheduler", "greedy"]
        # In a session of its own, so that Ctrl-C reaches it once, through us.
        child = subprocess.Popen(
            words,
            stdout=log,
            stderr=log,
            start_new_session=True,
            pass_fds=[read_end, hold.descriptor],
        )
        os.close(read_end)
        hold.note(
            f"process {os.getpid()}, skyproof reproduce; its jobs are of process {child.pid}, "
            f"which ends with it, or by: kill {child.pid}"
        )
        try:
            while child.poll() is None:
                time.sleep(_POLL_S)
                before = _note_finished(run, plan, cores, before)
        finally:
            os.close(write_end)
            child.wait()
            run.note_times(finished_jobs(run.folder).values())
    _note_finished(run, plan, cores, before)
    if child.returncode:
        said = place.read_bytes()[start:].decode(errors="replace")
        raise RunFolderError(_failure(run.folder, said))


def _note_finished(
    run: Run, plan: Plan, cores: int, before: Mapping[str, Timing]
) -> dict[str, Timing]:
    """Prints newly finished steps; a step that was done again is new, because its time differs."""
    finished = finished_jobs(run.folder)
    if finished == before:
        return finished
    titles = {step.id: step.title for step in plan.steps}
    jobs = {name: job for name, job in finished.items() if name in titles}
    left_s = time_left_s(plan.steps, {name: job.seconds for name, job in jobs.items()}, cores)
    left = "" if left_s is None else f", about {duration(left_s)} left"
    for number, (name, job) in enumerate(jobs.items(), start=1):
        if job != before.get(name):
            progress = f"({number} of {len(plan.steps)} steps{left})"
            say(f"  {titles[name]}: {job.seconds:.0f} s {progress}")
    # The report, the last step, says how long all others took.
    run.note_times(finished.values())
    return finished


def finished_jobs(folder: Path) -> dict[str, Timing]:
    """Reads Snakemake's benchmark files, `benchmarks/<kind>/<name>.tsv`, oldest first, by step."""
    places = (folder / "benchmarks").glob("*/*.tsv")
    files = sorted((path.stat().st_mtime_ns, path) for path in places)
    jobs = {}
    for _, path in files:
        with open(path, encoding="utf-8", errors="replace") as file:
            text = io.StringIO(file.read(_LONGEST))
        rows = list(csv.DictReader(text, delimiter="\t"))
        # A file may be seen before it is whole.
        seconds = _number(rows[-1].get("s")) if rows else None
        if seconds is not None:
            jobs[f"{path.parent.name}/{path.stem}"] = Timing(
                stage=path.parent.name,
                name=path.stem,
                seconds=round(seconds, 2),
                largest_memory_mb=_number(rows[-1].get("max_rss")),
            )
    return jobs


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if 0 <= value <= _LARGEST else None


def _failure(folder: Path, text: str) -> str:
    place = folder / "snakemake.log"
    log = failed_log(text)
    if log is None:
        return f"Snakemake stopped; see {place}, then give the same command again to go on."
    printed = _last_words(folder / log)
    reason = printed.rstrip(".") or "it printed nothing"
    place = folder / log if printed else place
    return f"A step failed ({reason}); see {place}, then give the same command again to go on."


def failed_log(text: str) -> str | None:
    """Finds the log of the first step that Snakemake's own log calls failed; None for none."""
    match = _FAILED.search(text)
    return None if match is None else match["log"].split(", ")[0]


def _last_words(path: Path) -> str:
    """The last line of a log; empty without one."""
    if not path.is_file():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    said = [line.removeprefix("skyproof: ").strip() for line in lines if line.strip()]
    return said[-1] if said else ""


@contextmanager
def _stop_signals() -> Iterator[None]:
    """Within, SIGTERM and the loss of the terminal end the run as Ctrl-C does."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = (signal.SIGTERM, signal.SIGHUP)
    kept = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
