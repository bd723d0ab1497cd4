"""Speaks the worker's protocol without Blender: python fake_worker.py PLAN LOG WORKER SCRATCH.

PLAN is a JSON list with what to do at each request, counted over all processes, or an object with
what to do with each job, by its seed; where it says nothing, "done":

- "done": the result holds the job's seed;
- "die": ended by a signal in the middle, half a result in its partial file;
- "exit": ends with words on standard error;
- "full": answers that the disk is full;
- "hang": never answers;
- "silent": closes its answers, and lives on;
- "garbled": answers what is no JSON;
- "lie": says that it is done, and leaves no result;
- "giant", "pickle", "other size", "nan": leaves a result that is none;
- "noise": prints other lines first, as Blender does;
- "done, then die": ends after its answer.

LOG gets a line per start and per request. A PLAN of "mute" ends before the first answer.
"""

import fcntl
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def logged(log: Path, line: str) -> int:
    """Adds a line; the number of requests before it."""
    with open(log, "a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        before = sum(each.startswith("request") for each in file)
        file.write(line + "\n")
    return before


def say(**message: object) -> None:
    print("skyproof-worker", json.dumps(message), flush=True)


def main() -> None:
    plan, log = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    logged(log, f"start {os.getpid()}")
    if plan == "mute":
        sys.exit("bpy is not for this machine")
    # Blender makes such a folder, and leaves it behind where it is killed.
    tempfile.mkdtemp(prefix="blender_")
    say(version=[4, 5, 0])
    for line in sys.stdin:
        job, result = map(Path, line.rstrip("\n").split("\t"))
        with np.load(job, allow_pickle=False) as stored:
            numbers = json.loads(str(stored["job"]))
        seed = numbers["seed"]
        number = logged(log, f"request {seed}")
        action = (
            plan.get(str(seed), "done")
            if isinstance(plan, dict)
            else [*plan, *["done"] * number, "done"][number]
        )
        partial = result.with_name(f".{result.name}.partial")
        if action == "die":
            partial.write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
        if action == "exit":
            sys.exit("Traceback of something\nMemoryError: no room for a picture")
        if action == "hang":
            time.sleep(3600)
        if action == "silent":
            os.close(sys.stdout.fileno())
            time.sleep(3600)
        if action == "full":
            say(failed=str(result), why="OSError: [Errno 28] No space left on device")
            continue
        if action == "noise":
            print("Fra:1 Mem:12.3M | skyproof-worker is not meant here\nSaved: 'x.exr'", flush=True)
        if action == "garbled":
            print("skyproof-worker", '{"done": ' * 100_000, flush=True)
            continue
        if action == "lie":
            say(done=str(result))
            continue
        with open(partial, "wb") as file:
            if action == "giant":
                # A header that claims more than any memory, and little behind it.
                header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6, 7)}
                np.lib.format.write_array_header_1_0(file, header)
                file.write(bytes(100))
            elif action == "pickle":
                np.save(file, np.array([{"seed": seed}], dtype=object), allow_pickle=True)
            elif action == "other size":
                np.save(file, np.zeros((3, 2, 7), np.float32))
            else:
                value = np.nan if action == "nan" else seed
                np.save(file, np.full((2, 2, 7), value, dtype=np.float32))
        os.replace(partial, result)
        say(done=str(result))
        if action == "done, then die":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main()
