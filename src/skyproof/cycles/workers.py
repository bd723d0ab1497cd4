"""Blender processes that turn job files into arrays; restarted when they die."""

from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import msgspec
import numpy as np

from skyproof.cycles.blender import Blender, worker_environment
from skyproof.cycles.jobs import Job
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import write_bytes

WORKER = Path(__file__).with_name("worker.py")

_MARK = "skyproof-worker "
_TRIES = 2
_LAST_LINES = 3
_DYING_S = 10.0
_LONGEST_LINE = 100_000
# Colour and coverage, and the ground's light.
_CHANNELS = 7


class Workers:
    """Several Blender processes of one thread each, used as a context; the first job starts them.

    A result depends on its job alone, for any number of processes. Results stay in the folder
    `results` under the jobs' digests, or if it is None until the context ends.
    """

    def __init__(self, blender: Blender, count: int, results: Path | None = None) -> None:
        if count < 1:
            raise ConfigurationError(f"count expects at least 1 process, got {count}.")
        self.blender, self.count = blender, count
        self._scratch = Path(tempfile.mkdtemp(prefix="skyproof-cycles-"))
        self.results = self._scratch / "results" if results is None else Path(results)
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        self._all = [_Process(blender, self._scratch, number) for number in range(count)]
        for process in self._all:
            self._idle.put(process)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def process_ids(self) -> list[int]:
        """The ids of the running processes."""
        return [number for process in self._all if (number := process.process_id) is not None]

    def close(self) -> None:
        """Ends the processes and removes their files."""
        for process in self._all:
            process.stop()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def run(
        self, jobs: Sequence[Job], *, on_done: Callable[[], None] | None = None
    ) -> list[np.ndarray]:
        """The results of all jobs, in their order; existing ones are read.

        Raises:
            RunFolderError: a job failed twice, a worker died twice in it, or the disk is full.
        """
        executor = ThreadPoolExecutor(self.count)
        try:
            futures = [executor.submit(self._one, job) for job in jobs]
            done = []
            for future in futures:
                done.append(future.result())
                if on_done:
                    on_done()
            return done
        except BaseException:
            # Threads wait for their processes: they end at once without them.
            for process in self._all:
                process.stop()
            raise
        finally:
            executor.shutdown(wait=True, cancel_futures=True)

    def _one(self, job: Job) -> np.ndarray:
        result = self.results / f"{job.digest(self.blender.version)}.npy"
        if result.exists():
            with suppress(_BadPicture):
                return _picture(result, job)
            # The file was written whole and damaged later, so it is rendered again.
        process = self._idle.get()
        try:
            return self._render(process, job, result)
        finally:
            self._idle.put(process)

    def _render(self, process: _Process, job: Job, result: Path) -> np.ndarray:
        place = self._scratch / f"{process.number}.npz"
        write_bytes(place, job.stored())
        result.parent.mkdir(parents=True, exist_ok=True)
        why = ""
        for _ in range(_TRIES):
            answer = process.ask(place, result)
            if answer.done is None:
                why = " ".join(answer.why.split())[:500]
                continue
            try:
                return _picture(result, job)
            except _BadPicture as unfit:
                why = str(unfit)
        raise RunFolderError(
            f"Blender failed {_TRIES} times at {job.name} ({why}); if memory or disk is short make "
            "room, then run the same command again (finished pictures are kept)."
        )


class _BadPicture(Exception):
    """A result that does not fit its job."""


def _picture(path: Path, job: Job) -> np.ndarray:
    """Reads a result; a header that claims more than the file holds takes no memory."""
    width, height = job.window_px[2:]
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise _BadPicture("its picture is missing or damaged") from error
    if found.shape != (height, width, _CHANNELS) or found.dtype != np.float32:
        raise _BadPicture(
            f"its picture has the shape {found.shape} of {found.dtype}, expected "
            f"{(height, width, _CHANNELS)} of float32"
        )
    picture = np.array(found)
    if not np.isfinite(picture).all():
        raise _BadPicture("its picture holds values that are not finite")
    return picture


class _Reply(msgspec.Struct):
    """A line of a worker: first a version, later "done", or "why" not."""

    done: str | None = None
    why: str = "it did not say"


class _Process:
    """One Blender process, started on demand and restarted after its death."""

    def __init__(self, blender: Blender, scratch: Path, number: int) -> None:
        self.number = number
        self._command = blender.command(WORKER, str(scratch))
        self._scratch = scratch
        self._log = scratch / f"{number}.log"
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    @property
    def process_id(self) -> int | None:
        """Its process id while it runs."""
        return None if self._process is None else self._process.pid

    def ask(self, job: Path, result: Path) -> _Reply:
        """Runs one job."""
        try:
            if self._process is None and not self._start():
                return _Reply(why=f"it did not start: {self._last_words()}")
            assert self._process is not None
            assert self._process.stdin is not None
            self._process.stdin.write(f"{job}\t{result}\n")
            self._process.stdin.flush()
            answer = self._listen()
        except msgspec.DecodeError:
            # The process lives, but its next lines cannot be trusted.
            self._end()
            return _Reply(why="its process answered in another form")
        except (BrokenPipeError, ValueError):
            answer = None
        if answer is None:
            why = f"its process died: {self._last_words()}"
            self._end()
            return _Reply(why=why)
        return answer

    def stop(self) -> None:
        """Ends it for good."""
        self._stopped = True
        self._end()

    def _start(self) -> bool:
        if self._stopped:
            return False
        with open(self._log, "w", encoding="utf-8") as log:
            try:
                self._process = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    errors="replace",
                    env=worker_environment(dict(os.environ), self._scratch),
                    # Ctrl-C is for us; the process ends when its input does.
                    start_new_session=True,
                )
            except OSError as error:
                # For example, no memory for one more process.
                log.write(str(error))
                return False
        if self._listen() is None:
            self._end()
            return False
        return True

    def _listen(self) -> _Reply | None:
        """The next line for us; None if the process has ended."""
        assert self._process is not None
        assert self._process.stdout is not None
        while line := self._process.stdout.readline(_LONGEST_LINE):
            if line.startswith(_MARK):
                return msgspec.json.decode(line.removeprefix(_MARK), type=_Reply)
        return None

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            # Kills its children, too: a launcher's child would hold the pipe open, and a thread
            # would wait for it.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if process.stdin is not None:
                # Unsent data cannot reach a dead process.
                with suppress(OSError):
                    process.stdin.close()

    def _last_words(self) -> str:
        process = self._process
        if process is not None:
            try:
                code = process.wait(_DYING_S)
            except subprocess.TimeoutExpired:
                return "it says nothing more, and does not end"
            if code < 0:
                return f"signal {-code}"
        lines = (
            self._log.read_text(encoding="utf-8", errors="replace").split("\n")
            if self._log.exists()
            else []
        )
        return (
            "; ".join([line.strip() for line in lines if line.strip()][-_LAST_LINES:])
            or "it said nothing"
        )
