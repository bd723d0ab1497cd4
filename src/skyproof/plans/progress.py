"""How far a reproduction is: which jobs are finished, what they took, how long the rest may take, which one failed."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from skyproof.files import write_bytes

__all__ = ["FinishedJob", "failed_log", "finished_jobs", "time_left_s", "write_timings"]

_FAILED = re.compile(
    r"^Error in (?:rule|group) [^\n]*:\n(?:    [^\n]*\n)*?    log: (?P<log>[^\n]+?) \(check log",
    re.MULTILINE,
)


@dataclass(frozen=True)
class FinishedJob:
    """One job that is done: its rule, what of, and what its last run took; memory in MB, None where not measured."""

    rule: str
    name: str
    seconds: float
    largest_memory_mb: float | None


def finished_jobs(folder: Path) -> list[FinishedJob]:
    """Reads Snakemake's benchmark files, `benchmarks/<rule>/<name>.tsv`, oldest first."""
    files = sorted(
        (path.stat().st_mtime_ns, path) for path in (folder / "benchmarks").glob("*/*.tsv")
    )
    jobs = []
    for _, path in files:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")), delimiter="\t"))
        # A file may be seen before it is whole.
        if rows and (seconds := _number(rows[-1].get("s"))) is not None:
            jobs.append(
                FinishedJob(path.parent.name, path.stem, seconds, _number(rows[-1].get("max_rss")))
            )
    return jobs


def time_left_s(
    jobs: Mapping[str, int], finished: Sequence[FinishedJob], cores: int
) -> float | None:
    """A guess: jobs still to do, each as long as its rule's finished ones took on average, spread over the cores.

    Rules of which none is finished count as the mean of all; None before the first job.
    """
    if not finished:
        return None
    every = fmean(job.seconds for job in finished)
    left_s = 0.0
    for rule, count in jobs.items():
        took = [job.seconds for job in finished if job.rule == rule]
        left_s += max(0, count - len(took)) * (fmean(took) if took else every)
    return left_s / cores


def failed_log(text: str) -> str | None:
    """The log file of the first job that Snakemake's own log calls failed; None where it names none."""
    found = _FAILED.search(text)
    return found["log"].partition(",")[0] if found else None


def write_timings(path: Path, jobs: Sequence[FinishedJob]) -> None:
    """Writes one row per finished job."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["rule", "name", "seconds", "largest_memory_mb"])
    for job in sorted(jobs, key=lambda each: (each.rule, each.name)):
        memory = "" if job.largest_memory_mb is None else f"{job.largest_memory_mb:.0f}"
        writer.writerow([job.rule, job.name, f"{job.seconds:.1f}", memory])
    write_bytes(path, text.getvalue().encode())


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None
