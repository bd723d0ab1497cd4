"""Processes that die, fail or hang: what is retried, what is said, what is kept."""

import json
import os
import shlex
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from skyproof.cycles.blender import Blender
from skyproof.cycles.jobs import Job
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.errors import ConfigurationError, RunFolderError
from tests.cycles.stage import one_job
from tests.render.bodies import scene, vehicles

FAKE = Path(__file__).with_name("fake_worker.py")


class Fake:
    """An interpreter that stands for Blender's, and what it was asked."""

    def __init__(self, folder, plan, *, wrapped=False):
        self.log = folder / "log"
        (folder / "plan.json").write_text(json.dumps(plan))
        program = folder / "python"
        words = shlex.join([sys.executable, str(FAKE), str(folder / "plan.json"), str(self.log)])
        # A wrapped one is a process of its own above the one that works, as a launcher of Blender
        # may be.
        program.write_text(
            f'#!/bin/sh\n{words} "$@"\nexit $?\n' if wrapped else f'#!/bin/sh\nexec {words} "$@"\n'
        )
        program.chmod(0o755)
        self.blender = Blender(program, True, "4.5.0")

    def _lines(self, kind):
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [int(line.split()[1]) for line in lines if line.startswith(kind)]

    @property
    def requests(self):
        return self._lines("request")

    @property
    def processes(self):
        return self._lines("start")


def job(seed):
    numbers = {"seed": seed}
    return Job(
        f"vehicle 1 of scene-{seed}", 0, (0, 0, 2, 2), numbers, {"values": np.zeros(3, np.float32)}
    )


def seeds(results):
    return [int(result[0, 0, 0]) for result in results]


def alive(process):
    try:
        # What ended and was not yet asked for counts as ended.
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def ended(processes):
    """Whether all of them end, which after a kill takes the system a moment."""
    until = time.monotonic() + 10
    while any(map(alive, processes)) and time.monotonic() < until:
        time.sleep(0.01)
    return not any(map(alive, processes))


def test_results_come_in_the_order_of_the_jobs(tmp_path):
    fake = Fake(tmp_path, ["noise"])
    with Workers(fake.blender, 2) as workers:
        results = workers.run([job(seed) for seed in range(9)])
        assert seeds(results) == list(range(9))
        assert sorted(fake.requests) == list(range(9))
        assert len(fake.processes) <= 2
        # The same again is only read.
        assert seeds(workers.run([job(4), job(11)])) == [4, 11]
    assert sorted(fake.requests) == [*range(9), 11]
    assert ended(fake.processes)


def test_a_damaged_result_is_drawn_again(tmp_path):
    fake = Fake(tmp_path, [])
    for damage in (b"", b"no array", None):
        with Workers(fake.blender, 1, tmp_path / "results") as workers:
            assert seeds(workers.run([job(3)])) == [3]
        (file,) = (tmp_path / "results").iterdir()
        file.write_bytes(file.read_bytes()[:-9] if damage is None else damage)
    with Workers(fake.blender, 1, tmp_path / "results") as workers:
        assert seeds(workers.run([job(3)])) == [3]
    assert fake.requests == [3] * 4


@pytest.mark.parametrize("how", ["die", "exit", "full", "done, then die"])
def test_what_goes_wrong_once_is_done_again(tmp_path, how):
    fake = Fake(tmp_path, ["done", how])
    with Workers(fake.blender, 1, tmp_path / "results") as workers:
        assert seeds(workers.run([job(seed) for seed in range(4)])) == [0, 1, 2, 3]
    again = [0, 1, 2, 3] if how == "done, then die" else [0, 1, 1, 2, 3]
    assert fake.requests == again
    # One that only says what went wrong goes on working.
    assert len(fake.processes) == (1 if how == "full" else 2)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("die", ("its process died", f"signal {signal.SIGKILL.value}", "memory")),
        ("exit", ("its process died", "MemoryError: no room for a picture", "memory")),
        ("full", ("No space left on device", "disk", "make room")),
        ("silent", ("its process died", "does not end")),
        ("garbled", ("its process answered in another form",)),
        ("lie", ("its picture is missing or damaged",)),
        ("giant", ("its picture is missing or damaged",)),
        ("pickle", ("its picture is missing or damaged",)),
        ("other size", ("its picture has the shape (3, 2, 7) of float32",)),
        ("nan", ("not finite",)),
    ],
)
def test_what_goes_wrong_twice_is_named(tmp_path, how, words, monkeypatch):
    monkeypatch.setattr("skyproof.cycles.workers._DYING_S", 0.5)
    fake = Fake(tmp_path, ["done", how, how])
    with (
        Workers(fake.blender, 1, tmp_path / "results") as workers,
        pytest.raises(RunFolderError) as caught,
    ):
        workers.run([job(seed) for seed in range(4)])
    message = str(caught.value)
    for word in ("vehicle 1 of scene-1", "2 times", "run the same command again", *words):
        assert word in message
    assert "\n" not in message
    assert fake.requests[:3] == [0, 1, 1]
    # What was finished is kept, and what was not has no name.
    kept = [path for path in (tmp_path / "results").iterdir() if not path.name.startswith(".")]
    if how in ("die", "exit", "full"):
        assert seeds(map(np.load, kept)) in ([0], [0, 2], [2, 0])
    fresh = Fake(tmp_path, [])
    fresh.log.unlink()
    with Workers(fresh.blender, 1, tmp_path / "results") as workers:
        assert seeds(workers.run([job(seed) for seed in range(4)])) == [0, 1, 2, 3]
    assert 0 not in fresh.requests


def test_one_that_does_not_start_is_named_with_its_last_words(tmp_path):
    fake = Fake(tmp_path, "mute")
    with (
        Workers(fake.blender, 1) as workers,
        pytest.raises(RunFolderError, match="did not start: bpy is not for this machine"),
    ):
        workers.run([job(0)])
    assert len(fake.processes) == 2


def test_an_interpreter_that_is_gone_is_named(tmp_path):
    fake = Fake(tmp_path, [])
    fake.blender.path.unlink()
    with (
        Workers(fake.blender, 1) as workers,
        pytest.raises(RunFolderError, match="vehicle 1 of scene-0") as caught,
    ):
        workers.run([job(0)])
    assert "No such file" in str(caught.value)


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_stop_ends_processes_that_never_answer(tmp_path, wrapped):
    fake = Fake(tmp_path, {1: "hang", 2: "hang"}, wrapped=wrapped)

    def stop():
        # Not before the others are in the middle of their jobs.
        until = time.monotonic() + 60
        while len(fake.requests) < 3 and time.monotonic() < until:
            time.sleep(0.01)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    results, threads = tmp_path / "results", threading.active_count()
    stopper = threading.Thread(target=stop)
    # The processes of pytest-xdist ignore the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        stopper.start()
        with pytest.raises(KeyboardInterrupt), Workers(fake.blender, 2, results) as workers:
            workers.run([job(seed) for seed in range(6)])
        stopper.join()
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended(fake.processes)
    assert threading.active_count() == threads
    files = [path for path in results.iterdir() if not path.name.startswith(".")]
    assert seeds(map(np.load, files)) == [0]
    fresh = Fake(tmp_path, [])
    fresh.log.unlink()
    with Workers(fresh.blender, 2, results) as workers:
        assert seeds(workers.run([job(seed) for seed in range(6)])) == list(range(6))
    assert sorted(fresh.requests) == [1, 2, 3, 4, 5]


def test_nothing_starts_for_finished_work(tmp_path):
    fake = Fake(tmp_path, [])
    with Workers(fake.blender, 1, tmp_path / "results") as workers:
        workers.run([job(0), job(1)])
    fake.log.unlink()
    with Workers(fake.blender, 1, tmp_path / "results") as workers:
        assert seeds(workers.run([job(1), job(0)])) == [1, 0]
        assert workers.run([]) == []
    assert fake.processes == []


def test_files_of_a_run_go_away_with_it(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "scratch").mkdir()
    fake = Fake(tmp_path, [])
    with Workers(fake.blender, 1) as workers:
        assert seeds(workers.run([job(0)])) == [0]
        assert list((tmp_path / "scratch").iterdir())
    assert not list((tmp_path / "scratch").iterdir())


def test_other_packages_stay_out_of_blenders_python(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    fake = Fake(tmp_path, [])
    fake.blender.path.write_text(
        fake.blender.path.read_text().replace("exec", 'test -z "$PYTHONPATH" && exec', 1)
    )
    with Workers(fake.blender, 1) as workers:
        assert seeds(workers.run([job(0)])) == [0]


def test_no_workers_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="count expects at least 1"):
        Workers(Fake(tmp_path, []).blender, 0)


def test_another_light_path_count_or_blender_is_another_result():
    place, batch = scene((0, 0, 0)), vehicles()
    first, again = (one_job(place, batch, settings=CyclesSettings(samples=4)) for _ in range(2))
    assert first.digest("4.5.1") == again.digest("4.5.1")
    others = [
        one_job(place, batch, settings=CyclesSettings(samples=5)).digest("4.5.1"),
        one_job(place, batch, settings=CyclesSettings(samples=4), ground=0.3).digest("4.5.1"),
        one_job(scene((0, 0, 1)), batch, settings=CyclesSettings(samples=4)).digest("4.5.1"),
        one_job(place, vehicles(seed=1), settings=CyclesSettings(samples=4)).digest("4.5.1"),
        first.digest("4.5.2"),
    ]
    assert len({first.digest("4.5.1"), *others}) == 6


@pytest.mark.blender
def test_a_real_process_killed_in_the_middle_of_its_job(blender, workers, tmp_path):
    easy, hard = (
        one_job(
            scene((0, 0, 0)), vehicles(), settings=CyclesSettings(samples=samples), margin_m=0.25
        )
        for samples in (1, 800)
    )
    killed = []

    def kill():
        # The other jobs wait in line, so that this one is at work.
        (process,) = [each.process.pid for each in mortal.processes]
        time.sleep(0.15)
        os.killpg(process, signal.SIGKILL)
        killed.append(process)

    with Workers(blender, 1, tmp_path) as mortal:
        mortal.run([easy])
        timer = threading.Timer(0.0, kill)
        timer.start()
        (result,) = mortal.run([hard])
        timer.join()
        (process,) = [each.process.pid for each in mortal.processes]
    assert killed
    assert killed != [process]
    np.testing.assert_array_equal(result, workers.run([hard])[0])
    assert len(list(tmp_path.iterdir())) == 2
