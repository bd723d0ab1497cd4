"""Speaks the worker's protocol without Blender: python fake_worker.py PLAN LOG WORKER SCRATCH.

PLAN is a JSON list with what to do at each request, counted over all processes, or an object with
what to do with each job, by its seed; where it says nothing, "done":

- "done": the result holds the job's seed;
- "die": ended by a signal in the middle, half a result in its partial file;
- "exit": ends with words on standard error;
- "full": answers that the disk is full;
- "hang": never answers;
- "noise": prints other lines first, as Blender does;
- "done, then die": ends after its answer.

LOG gets a line per start and per request. A PLAN of "mute" ends before the first answer.
"""

import fcntl
import json
import os
import signal
import sys
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
    say(version=[4, 5, 0])
    for line in sys.stdin:
        job, result = map(Path, line.rstrip("\n").split("\t"))
        with np.load(job) as stored:
            seed = json.loads(str(stored["job"]))["seed"]
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
        if action == "full":
            say(failed=str(result), why="OSError: [Errno 28] No space left on device")
            continue
        if action == "noise":
            print("Fra:1 Mem:12.3M | skyproof-worker is not meant here\nSaved: 'x.exr'", flush=True)
        with open(partial, "wb") as file:
            np.save(file, np.full((2, 2, 7), seed, dtype=np.float32))
        os.replace(partial, result)
        say(done=str(result))
        if action == "done, then die":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main()
