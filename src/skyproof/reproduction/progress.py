"""How far Snakemake is: which steps are finished, what they took, which one failed."""

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

# What a cluster said may have lines of its own, up to the next message with its time.
_FAILED = re.compile(
    r"^Error in (?:rule|group) [^\n]*:\n(?P<said>(?:(?!\[|Error in )[^\n]*\n)*?)"
    r"    log: (?P<logs>[^\n]+?) \(check log",
    re.MULTILINE,
)
_REFUSED = re.compile(r"The error message was '(?P<words>.*?)'\.\n", re.DOTALL)
_ENDED = re.compile(r"SLURM status is: '(?P<status>\w+)'")


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

    @property
    def timing(self) -> dict[str, str | float | None]:
        """Its row of `timings.json`."""
        return {
            "stage": self.kind,
            "name": self.name,
            "seconds": round(self.seconds, 2),
            "largest_memory_mb": self.largest_memory_mb,
        }


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


@dataclass(frozen=True)
class FailedJob:
    """The first step that Snakemake's own log calls failed.

    Attributes:
        logs: files of what it printed, its own first; relative to the run folder, or whole. None
            where a cluster refused it, because then an earlier try wrote them.
        reason: what the cluster says beside that it failed: why it refused the step, or a status
            such as TIMEOUT; empty where it says nothing.
    """

    logs: tuple[str, ...]
    reason: str = ""


def failed_job(text: str) -> FailedJob | None:
    """Finds the first failed step in Snakemake's own log; None for none."""
    match = _FAILED.search(text)
    if match is None:
        return None
    refused = _REFUSED.search(match["said"])
    ended = _ENDED.search(match["said"])
    if refused:
        return FailedJob((), " ".join(refused["words"].split()))
    status = ended["status"] if ended else "FAILED"
    reason = "" if status == "FAILED" else f"Slurm says {status}"
    return FailedJob(tuple(match["logs"].split(", ")), reason)


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if 0 <= value <= _LARGEST else None
