"""A plan done by Snakemake: on many cores of this machine, or on a cluster."""

import os
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

from skyproof.assessment.run import Run, Step, duration, time_left_s
from skyproof.console import say
from skyproof.errors import RunFolderError
from skyproof.files import Hold
from skyproof.reproduction.plan import Plan
from skyproof.reproduction.progress import FinishedJob, failed_job, finished_jobs

SNAKEFILE = Path(__file__).with_name("Snakefile")

_POLL_S = 1.0
_PATIENCE_S = 30.0


def shell_line(step: Step, config: Mapping[str, Any]) -> Callable[[object], str]:
    """Returns the shell's words for a step in a process of its own, every one quoted.

    It is a function, because Snakemake looks for wildcards in text, and a path may have braces.

    Args:
        step: the step.
        config: the values of `--config`, device and blender.
    """
    words = [sys.executable, "-m", "skyproof.reproduction", "step", step.id]
    line = shlex.join([*words, *(f"--{name}={value}" for name, value in config.items())])
    return lambda wildcards: line


def output_of(
    step: Step, directory: Callable[[str], Any], update: Callable[[str], Any]
) -> list[Any]:
    """Returns a step's outputs for Snakemake.

    Args:
        step: the step.
        directory: Snakemake's mark of a folder.
        update: Snakemake's mark of a file that a stopped job is not to lose, because the next try
            goes on from the files beside it.
    """
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
    """Runs Snakemake on a plan, and prints a line per finished step.

    Args:
        plan: the plan that the workflow reads, too.
        run: the run folder.
        command: Snakemake's words, options of its executor included.
        cores: how many steps run side by side, for the time left.
        hold: the run folder's lock, which Snakemake holds as long as it lives. It ends with this
            process, however that ends (`skyproof.reproduction.watched`).

    Raises:
        RunFolderError: a step failed; names its log.
    """
    place = run.folder / "snakemake.log"
    before = set(_finished(run.folder, plan))
    if before:
        say(f"  {len(before)} steps were finished before")
    with open(place, "ab") as log, _stop_signals(), _pipe() as read_end:
        start = log.tell()
        watched = [sys.executable, "-m", "skyproof.reproduction.watched", str(read_end)]
        # In a session of its own, so that Ctrl-C reaches it once, through us.
        child = subprocess.Popen(
            [*watched, str(hold.descriptor), *command],
            stdout=log,
            stderr=log,
            start_new_session=True,
            pass_fds=[read_end, hold.descriptor],
        )
        hold.note(
            f"process {os.getpid()}, skyproof reproduce; its jobs are of process {child.pid}, "
            f"which ends with it, or by: kill {child.pid}"
        )
        try:
            while child.poll() is None:
                time.sleep(_POLL_S)
                finished = _say_finished(run.folder, plan, cores, before)
                if finished != before:
                    # The report, the last step, says how long all others took.
                    run.note_times([job.timing for job in finished_jobs(run.folder)])
                before = finished
        except BaseException:
            _end(child)
            raise
        finally:
            run.note_times([job.timing for job in finished_jobs(run.folder)])
    _say_finished(run.folder, plan, cores, before)
    if child.returncode:
        said = place.read_bytes()[start:].decode(errors="replace")
        raise RunFolderError(_failure(run.folder, said))


def _say_finished(
    folder: Path, plan: Plan, cores: int, before: set[FinishedJob]
) -> set[FinishedJob]:
    """Prints new steps; one that was done again counts as new, as it took another time."""
    finished = _finished(folder, plan)
    left_s = time_left_s(plan.steps, {job.id: job.seconds for job in finished}, cores)
    titles = {step.id: step.title for step in plan.steps}
    for number, job in enumerate(finished, start=1):
        if job not in before:
            left = "" if left_s is None else f", about {duration(left_s)} left"
            progress = f"({number} of {len(plan.steps)} steps{left})"
            say(f"  {titles[job.id]}: {job.seconds:.0f} s {progress}")
    return set(finished)


def _finished(folder: Path, plan: Plan) -> list[FinishedJob]:
    """The finished steps of the plan: an earlier call may have had more of them."""
    known = {step.id for step in plan.steps}
    return [job for job in finished_jobs(folder) if job.id in known]


def _failure(folder: Path, text: str) -> str:
    place = folder / "snakemake.log"
    job = failed_job(text)
    if job is None:
        return f"Snakemake stopped; see {place}, then give the same command again to go on."
    # A job that a cluster could not start printed nothing of its own.
    printed = [folder / log for log in job.logs if _last_words(folder / log)]
    reason = job.reason
    if printed:
        place = printed[0]
        reason = reason or _last_words(place)
    reason = reason.rstrip(".") or "it printed nothing"
    return f"A step failed ({reason}); see {place}, then give the same command again to go on."


def _last_words(path: Path) -> str:
    """The last line of a log; empty without one."""
    if not path.is_file():
        return ""
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    said = [line.removeprefix("skyproof: ").strip() for line in lines if line.strip()]
    return said[-1] if said else ""


@contextmanager
def _pipe() -> Iterator[int]:
    """Yields the read end of a pipe whose other end this process alone holds."""
    read_end, write_end = os.pipe()
    try:
        yield read_end
    finally:
        os.close(read_end)
        os.close(write_end)


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

    numbers = (signal.SIGTERM, signal.SIGHUP)
    kept = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
