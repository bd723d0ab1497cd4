"""Runs a program that ends when the process that asked for it dies, however it dies.

`python -m skyproof.reproduction.watched READ LOCK WORD ...`: READ is the read end of a pipe whose
other end only that process holds; the system closes it when the process dies or is killed. LOCK is
a descriptor that the program is to inherit. This process leads a session of its own, so that a
signal reaches the program and all that it has started.
"""

import os
import select
import signal
import subprocess
import sys
from types import FrameType

_POLL_S = 0.5
_PATIENCE_S = 30.0


def watch(read_end: int, lock: int, words: list[str]) -> int:
    """Runs a program until it ends or nobody holds the pipe's other end; returns its exit code."""
    ended: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        ended.append(number)

    # Ctrl-C reaches the program as well, which then decides what is left to do.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    child = subprocess.Popen(words, pass_fds=[lock])
    while child.poll() is None:
        if ended or select.select([read_end], [], [], _POLL_S)[0]:
            _end(child)
    return child.returncode


def _end(child: subprocess.Popen[bytes]) -> None:
    """Ends the program and everything in this session, politely at first."""
    os.killpg(0, signal.SIGINT)
    try:
        child.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(watch(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))
