"""The machine, versions and times of a run."""

import os
import platform
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from skyproof import __version__
from skyproof.documents import read_document
from skyproof.files import write_json
from skyproof.results.stored import read_environment

_LONGEST_COMMAND = 2000
"""Characters that are kept of a command, which may name hundreds of photographs."""


def write_environment(path: Path, device: str, seed: object) -> None:
    """Writes the record at the start of a run; the commands of earlier starts are kept."""
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
            for name in ("torch", "torchvision", "ultralytics", "transformers", "numpy", "rasterio")
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


def note_end(path: Path) -> None:
    """Records when the run ended."""
    remedy = "move it away and give the same command again"
    noted: dict[str, Any] = read_document(path, dict[str, Any], remedy)
    write_json(path, {**noted, "finished": _now()})


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def _commit() -> str | None:
    """Returns the commit of a source checkout; None for an installed package, wherever it lies."""
    here = Path(__file__).resolve().parents[3]
    if not (here / ".git").exists():
        return None
    with suppress(OSError, subprocess.TimeoutExpired):
        answer = subprocess.run(
            ["git", "-C", str(here), "rev-parse", "--short", "HEAD"],
            capture_output=True,
            text=True,
            timeout=5,
        )
        return answer.stdout.strip() or None
    return None


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
