"""How far Snakemake is: which steps are finished, what they took, which one failed."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

__all__ = ["FinishedJob", "failed_log", "finished_jobs"]

_FAILED = re.compile(
    r"^Error in (?:rule|group) [^\n]*:\n(?:    [^\n]*\n)*?    log: (?P<log>[^\n]+?) \(check log",
    re.MULTILINE,
)


# Of a benchmark file, in characters, and of a number in it; more is none of Snakemake's.
_LONGEST = 10_000
_LARGEST = 1e9


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


def finished_jobs(folder: Path) -> list[FinishedJob]:
    """Reads Snakemake's benchmark files, `benchmarks/<kind>/<name>.tsv`, oldest first."""
    places = (folder / "benchmarks").glob("*/*.tsv")
    files = sorted((path.stat().st_mtime_ns, path) for path in places)
    jobs = []
    for _, path in files:
        with open(path, encoding="utf-8", errors="replace") as file:
            text = io.StringIO(file.read(_LONGEST))
        rows = list(csv.DictReader(text, delimiter="\t"))
        # A file may be seen before it is whole.
        seconds = _number(rows[-1].get("s")) if rows else None
        if seconds is not None:
            memory = _number(rows[-1].get("max_rss"))
            jobs.append(FinishedJob(path.parent.name, path.stem, seconds, memory))
    return jobs


def failed_log(text: str) -> str | None:
    """Returns the log of the first step that Snakemake's own log calls failed; None for none."""
    match = _FAILED.search(text)
    return match["log"].partition(",")[0] if match else None


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if 0 <= value <= _LARGEST else None
