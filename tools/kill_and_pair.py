"""Kills whole runs at random moments, and starts two at once; the results must be the same bytes.

    python tools/kill_and_pair.py FOLDER [--kills 50] [--pairs 20] [--seed 0]

FOLDER must not exist yet. A tiny assessment, and tiny reproductions in one process and by
Snakemake, are run once without harm. Then each is started again and again, and killed (SIGKILL, to
the process that the user started and to nobody else) at a random moment, until so many kills have
hit; a run that has got through is compared with the unharmed one, file by file by SHA-256. After
that pairs of the same command on the same `--out` are started at once: one must end with exit code
0, the other with 0 or with exit code 2 and one sentence that says who works there, and what is left
must be the same bytes, too. FOLDER/kill_and_pair.json says what happened; the exit code is 1 if
anything differed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TINY_PRESET = ROOT / "tests" / "reproduction" / "tiny.json"
# By a suite that is far too small.
ASSESS = """
import sys
from skyproof.main import run
from tests.tiny_suite import tiny_suite

with tiny_suite():
    sys.exit(run(["assess", "retinanet", "--device", "cpu", "--out", sys.argv[1]]))
"""
REPRODUCE = ["-m", "skyproof", "reproduce", "--preset", str(TINY_PRESET), "--device", "cpu"]
WHOLE_RUNS = {
    "assess": ["-c", ASSESS],
    "reproduce, one process": [*REPRODUCE, "--cores", "1", "--out"],
    "reproduce, Snakemake": [*REPRODUCE, "--cores", "2", "--out"],
}
# Times, machines and commands differ from run to run, and so do the pages that show them.
PASSING = {
    "README.md",
    "environment.json",
    "timings.json",
    "report.html",
    "steps.jsonl",
    "snakemake.log",
}
PASSING_FOLDERS = {".snakemake", "logs", "benchmarks"}
PATIENCE_S = 600.0
BUSY = "is being written by another process"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50, help="for assess, and for reproduce")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.folder = given.folder.resolve()
    given.folder.mkdir(parents=True)
    draws = random.Random(given.seed)
    unharmed: dict[str, tuple[dict[str, str], float]] = {}
    record: dict[str, Any] = {"seed": given.seed}
    for name, words in WHOLE_RUNS.items():
        place = given.folder / "unharmed" / name.replace(", ", "-").replace(" ", "-")
        started = time.monotonic()
        code, said = finished(start([*words, str(place)]))
        if code:
            raise SystemExit(f"{name} fails without harm: {said}")
        unharmed[name] = digests(place), time.monotonic() - started
        tell(f"{name}: {unharmed[name][1]:.0f} s unharmed, {len(unharmed[name][0])} files")
    # Snakemake starts a process for every step: a kill of it costs the most time.
    by_snakemake = given.kills // 4
    shares = {
        "assess": given.kills,
        "reproduce, one process": given.kills - by_snakemake,
        "reproduce, Snakemake": by_snakemake,
    }
    record["kills"] = {
        name: kill(given.folder / "killed", name, count, *unharmed[name], draws)
        for name, count in shares.items()
    }
    record["pairs"] = pair(given.folder, given.pairs, unharmed, draws)
    (given.folder / "kill_and_pair.json").write_text(json.dumps(record, indent=1))
    bad = sum(row["different"] for row in [*record["kills"].values(), *record["pairs"].values()])
    tell("everything ended in the same bytes" if not bad else f"{bad} runs DIFFER")
    return int(bad > 0)


def kill(
    folder: Path, name: str, count: int, files: dict[str, str], seconds: float, draws: random.Random
) -> dict[str, Any]:
    """Kills a whole run so often, and compares every run that got through."""
    record = {"kills": 0, "runs": 0, "different": 0, "busy": 0, "files": len(files)}
    while record["kills"] < count:
        place = folder / f"{name.split(',')[0]}-{record['runs']}"
        while True:
            process = start([*WHOLE_RUNS[name], str(place)])
            try:
                # Two thirds: most moments are hit, and every run gets through in a few tries.
                limit_s = draws.uniform(0.0, seconds * 2 / 3)
                code, said = finished(process, limit_s if record["kills"] < count else PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.kill(process.pid, signal.SIGKILL)
                process.communicate()
                record["kills"] += 1
                continue
            if code == 2 and BUSY in said:
                # What the killed process started is still ending.
                record["busy"] += 1
                time.sleep(1.0)
                continue
            if code:
                raise SystemExit(f"{name} does not go on after a kill: {said}")
            break
        record["runs"] += 1
        record["different"] += differs(name, place, files)
        tell(f"{name}: {record['kills']} kills, {record['runs']} runs finished after them")
        shutil.rmtree(place)
    return record


def pair(
    folder: Path,
    count: int,
    unharmed: dict[str, tuple[dict[str, str], float]],
    draws: random.Random,
) -> dict[str, dict[str, int]]:
    """Starts two of the same command at once; gives per command how these pairs ended."""
    commands = {**WHOLE_RUNS, **single_commands(folder / "unharmed" / "assess")}
    record: dict[str, dict[str, int]] = {}
    files = {name: known for name, (known, _) in unharmed.items()}
    for number in range(count):
        name = list(commands)[number % len(commands)]
        if name not in files:
            alone = folder / "unharmed" / name
            code, said = finished(start([*commands[name], str(alone)]))
            if code:
                raise SystemExit(f"{name} fails without harm: {said}")
            files[name] = digests(alone)
        place = folder / "pairs" / f"{number}"
        first = start([*commands[name], str(place)])
        time.sleep(draws.uniform(0.0, 3.0))
        second = start([*commands[name], str(place)])
        ends = [finished(first), finished(second)]
        row = record.setdefault(
            name, {"pairs": 0, "refused as busy": 0, "refused as existing": 0, "different": 0}
        )
        row["pairs"] += 1
        row["refused as busy"] += sum(BUSY in said for _, said in ends)
        row["refused as existing"] += sum("exists already" in said for _, said in ends)
        unkind = [
            said
            for code, said in ends
            if code and (code != 2 or len(said.strip().splitlines()) != 1)
        ]
        if unkind or all(code for code, _ in ends):
            tell(f"{name}: a pair ended with {ends}")
            row["different"] += 1
        else:
            row["different"] += differs(name, place, files[name])
        tell(f"pair {number + 1} of {count}, {name}: {row}")
    return record


def single_commands(run: Path) -> dict[str, list[str]]:
    """Commands on the unharmed run's files, but for the place that they write."""
    world = f"--backgrounds {run}/backgrounds --fleet {run}/fleets"
    few = "--settings.steps 4 --device cpu"
    data = f"--data {run}/datasets/test --validation {run}/datasets/test"
    judged = f"--original {run}/datasets/test --camouflages {run}/camouflages/T-U"
    detectors = f"--detectors {run}/detectors/retinanet"
    commands = {
        "ground": "ground --tiling.size-px 96",
        "vehicles": "vehicles --counts 3 2 2 3",
        "render": f"render --scenes {run}/scenes/test.jsonl {world}/test",
        "train": f"train --detector retinanet {data} {few}",
        "attack": f"attack T-U {detectors} {world}/attack {few}",
        "score": f"score {detectors} {judged} {world}/test",
    }
    return {name: ["-m", "skyproof", *text.split(), "--out"] for name, text in commands.items()}


def start(words: Sequence[str]) -> subprocess.Popen[str]:
    """Starts Python with these words, as the only process that a kill will reach."""
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str], limit_s: float = PATIENCE_S) -> tuple[int, str]:
    """Waits for a process; gives its exit code and what it said on the error stream."""
    _, said = process.communicate(timeout=limit_s)
    return process.returncode, said


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of everything below a folder that must be the same in every run; of a file its own.

    Columns of seconds in tables are not compared.
    """
    paths = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in paths
        if path.is_file()
        and path.name not in PASSING
        and not PASSING_FOLDERS & set(path.relative_to(folder).parts)
    }


def differs(name: str, place: Path, files: dict[str, str]) -> bool:
    """Says whether a finished run's files are others, and tells which."""
    found = digests(place)
    changed = sorted(key for key in {*files, *found} if files.get(key) != found.get(key))
    if changed:
        tell(f"{name}: {len(changed)} of {len(files)} files differ, the first is {changed[0]}")
    return bool(changed)


def tell(text: str) -> None:
    print(time.strftime("%H:%M:%S"), text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
