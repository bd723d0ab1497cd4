"""Blender processes that turn job files into arrays; restarted when they die."""

import os
import queue
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from pathlib import Path

import msgspec
import numpy as np

from skyproof.cycles.blender import Blender, find_blender, worker_environment
from skyproof.cycles.jobs import WORKER, Job
from skyproof.cycles.settings import Rendering
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import write_bytes

_MARK = "skyproof-worker "
_TRIES = 2
_LAST_LINES = 3
_DYING_S = 10.0
_LONGEST_LINE = 100_000
_CHANNELS = 7  # colour, coverage and the ground's light


class Workers(AbstractContextManager["Workers"]):
    """Several Blender processes of one thread each, used as a context; the first job starts them.

    A result depends on its job alone, for any number of processes. Results stay in the folder
    `results` under the jobs' digests; if it is None, they are kept until the context ends.
    """

    def __init__(self, blender: Blender, count: int, results: Path | None = None) -> None:
        if count < 1:
            raise ConfigurationError(f"count expects at least 1 process, got {count}.")
        self.blender, self.count = blender, count
        self._scratch = Path(tempfile.mkdtemp(prefix="skyproof-cycles-"))
        self.results = self._scratch / "results" if results is None else Path(results)
        self.processes = [_Process(blender, self._scratch, number) for number in range(count)]
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        for process in self.processes:
            self._idle.put(process)

    def __exit__(self, *_: object) -> None:
        self._stop()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _stop(self) -> None:
        for process in self.processes:
            process.stop()

    def run(self, jobs: Sequence[Job]) -> list[np.ndarray]:
        """The results of all jobs, in their order; existing ones are read."""
        executor = ThreadPoolExecutor(self.count)
        try:
            return list(executor.map(self._one, jobs))
        except BaseException:
            # The threads wait for their processes, so they end as soon as the processes do.
            self._stop()
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

    def _render(self, process: "_Process", job: Job, result: Path) -> np.ndarray:
        write_bytes(process.job, job.stored())
        result.parent.mkdir(parents=True, exist_ok=True)
        why = ""
        for _ in range(_TRIES):
            why = " ".join(process.ask(result).split())[:500]
            if why:
                continue
            try:
                return _picture(result, job)
            except _BadPicture as unfit:
                why = str(unfit)
        raise RunFolderError(
            f"Blender failed {_TRIES} times at {job.name} ({why}); if memory or disk is short make "
            "room, then run the same command again (finished pictures are kept)."
        )


def open_workers(rendering: Rendering, results: Path | None = None) -> Workers:
    """Opens Blender processes as a context; by default one per core that may be used."""
    of_system = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if of_system else os.cpu_count() or 1
    return Workers(find_blender(rendering.blender), rendering.workers or cores, results)


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
        self.job = scratch / f"{number}.npz"
        self.process: subprocess.Popen[str] | None = None
        self._command = blender.command(WORKER, str(scratch))
        self._environment = worker_environment(dict(os.environ), scratch)
        self._log = scratch / f"{number}.log"
        self._stopped = False

    def ask(self, result: Path) -> str:
        """Runs the job that was written to `job`; returns why it failed, or an empty text."""
        answer: _Reply | None = None
        try:
            if self.process is None and not self._start():
                return f"it did not start: {self._last_words()}"
            assert self.process is not None
            assert self.process.stdin is not None
            self.process.stdin.write(f"{self.job}\t{result}\n")
            self.process.stdin.flush()
            answer = self._listen()
        except msgspec.DecodeError:
            # The process lives, but its next lines cannot be trusted.
            self._end()
            return "its process answered in another form"
        except (BrokenPipeError, ValueError):
            pass
        if answer is None:
            why = f"its process died: {self._last_words()}"
            self._end()
            return why
        return answer.why if answer.done is None else ""

    def stop(self) -> None:
        """Ends the process for good."""
        self._stopped = True
        self._end()

    def _start(self) -> bool:
        if self._stopped:
            return False
        with open(self._log, "w", encoding="utf-8") as log:
            try:
                self.process = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    errors="replace",
                    env=self._environment,
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
        """Returns the worker's next line for skyproof; None if the process has ended."""
        assert self.process is not None
        assert self.process.stdout is not None
        while line := self.process.stdout.readline(_LONGEST_LINE):
            if line.startswith(_MARK):
                return msgspec.json.decode(line.removeprefix(_MARK), type=_Reply)
        return None

    def _end(self) -> None:
        process, self.process = self.process, None
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
        if self.process is not None:
            try:
                code = self.process.wait(_DYING_S)
            except subprocess.TimeoutExpired:
                return "it says nothing more, and does not end"
            if code < 0:
                return f"signal {-code}"
        said = b""
        with suppress(FileNotFoundError):
            said = self._log.read_bytes()
        lines = [line.strip() for line in said.decode(errors="replace").split("\n")]
        return "; ".join([line for line in lines if line][-_LAST_LINES:]) or "it said nothing"
