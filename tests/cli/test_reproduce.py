"""`skyproof reproduce`: refusals, dry run, a failing job, interruption; the whole of it is in tests/workflow."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.cli.conftest import Skyproof

TINY = Path(__file__).parents[1] / "workflow" / "tiny.json"


def test_dry_run_says_what_would_be_done_and_writes_nothing(tmp_path: Path, skyproof: Skyproof) -> None:
    out = tmp_path / "run"
    answer = skyproof("reproduce", "--preset", TINY, "--out", out, "--dry-run")
    assert answer.code == 0, answer.err
    assert (
        "15 jobs (world 1, render 3, train 1, palette 1, attack 4, control 1, measure 1, score 2, tables 1)"
        in answer.out
    )
    assert "-m snakemake --snakefile" in answer.out
    assert f"--configfile {TINY}" in answer.out
    assert not out.exists()


def test_bad_input_is_refused_before_anything_is_written(
    tmp_path: Path, skyproof: Skyproof, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    skyproof("reproduce", "--preset", "quik", "--out", out).refused("quick", "paper", "quik")
    skyproof("reproduce", "--preset", TINY, "--out", out, "--cores", 0).refused("--cores", "0")
    skyproof("reproduce", "--preset", TINY, "--out", out, "--device", "cuda:99").refused("cuda:99")
    other = tmp_path / "other.json"
    other.write_text(json.dumps({**json.loads(TINY.read_text()), "detectors": ["ssd"]}))
    skyproof("reproduce", "--preset", other, "--out", out).refused("ssd")
    monkeypatch.setattr("skyproof.cli.reproduce.find_spec", lambda name: None)
    skyproof("reproduce", "--preset", TINY, "--out", out).refused("pip install 'skyproof[reproduce]'")
    assert not out.exists()


def test_another_run_in_the_folder(tmp_path: Path, skyproof: Skyproof) -> None:
    (tmp_path / "run").mkdir()
    # A run stopped before its first stage: only these two are there.
    (tmp_path / "run" / "config.json").write_text(json.dumps({"preset": "tiny", **json.loads(TINY.read_text())}))
    with open(tmp_path / "run" / ".lock", "w") as held:
        fcntl.flock(held, fcntl.LOCK_SH)  # even one that would share it
        skyproof("reproduce", "--preset", TINY, "--out", tmp_path / "run").refused("Another run")
    (tmp_path / "run" / "scores").mkdir()
    changed = tmp_path / "tiny.json"
    changed.write_text(json.dumps({**json.loads(TINY.read_text()), "seed": 5}))
    skyproof("reproduce", "--preset", changed, "--out", tmp_path / "run").refused("(seed)", "another --out")


def test_a_failing_job_is_named_with_its_last_words(tmp_path: Path, skyproof: Skyproof) -> None:
    broken = tmp_path / "broken.json"
    tiny = json.loads(TINY.read_text())
    broken.write_text(json.dumps({**tiny, "world": {**tiny["world"], "test_images": 0}}))
    answer = skyproof("reproduce", "--preset", broken, "--out", tmp_path / "run", "--cores", 1)
    answer.refused("at least 1", str(tmp_path / "run" / "logs" / "world" / "world.log"), "same command")


def test_an_interrupt_ends_all_processes(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skyproof", "reproduce", "--preset", TINY, "--out", tmp_path / "run"]
    run = subprocess.Popen(
        list(map(str, command)),
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        # A parent may have had interrupts ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    until = time.monotonic() + 60
    while time.monotonic() < until and not (tmp_path / "run" / "logs" / "world" / "world.log").exists():
        time.sleep(0.05)
    below = psutil.Process(run.pid).children(recursive=True)
    assert len(below) >= 2  # Snakemake and a job
    run.send_signal(signal.SIGINT)
    assert run.wait(60) == 130
    assert run.stderr is not None
    assert run.stderr.read() == "skyproof: stopped; give the same command again to go on.\n"
    assert not [process for process in below if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]
