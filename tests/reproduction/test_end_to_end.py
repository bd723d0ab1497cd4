"""A tiny reproduction is killed in the middle of an attack and given again.

What was finished stays, and the rest is done.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.layout import Layout
from skyproof.reproduction.plan import reproduction_plan
from skyproof.reproduction.preset import RENDERED, read_preset
from skyproof.storage import read_tensors
from tests.barely_trained import count_everything

TINY = Path(__file__).with_name("tiny.json")
# Steps of an attack that take no judging half-way, but for the one in which it is killed.
STEPS = {"texture": 8, "shape": 1, "sequential": 1, "parallel": 1}
WORLD = {
    *("ground/ground", "vehicles/fleets"),
    *(f"{kind}/{split}" for kind in ("scenes", "render") for split in RENDERED),
}


def begin(folder, preset):
    """Makes the world here, because each step would be a process of its own; returns the others."""
    name, _, values, read = read_preset(str(preset))
    write_json(Layout(folder).config, {"preset": name, **values})
    steps = reproduction_plan(read, folder).steps
    for step in steps:
        if step.id in WORLD:
            step.work()
    return {step.id for step in steps} - WORLD


def start(folder, preset):
    command = [sys.executable, "-m", "skyproof", "reproduce", "--preset", preset]
    return subprocess.Popen(
        [*command, "--out", folder, "--cores", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def kill(run):
    """As a power cut would: everything at once."""
    processes = [*psutil.Process(run.pid).children(recursive=True), psutil.Process(run.pid)]
    for process in processes:
        process.kill()
    psutil.wait_procs(processes, timeout=30)


def kill_when(run, reached):
    """Lets it run until something is reached."""
    until = time.monotonic() + 240
    while not reached():
        assert run.poll() is None, run.stdout.read()
        assert time.monotonic() < until
        time.sleep(0.01)
    kill(run)


def checkpointed_step(folder):
    """Which step the last checkpoint is of; 0 before there is one, too."""
    try:
        return read_tensors(folder / "checkpoint.safetensors", "run again")[1]["step"]
    except StoredFileError:
        return 0


@pytest.mark.slow
def test_killed_in_an_attack_and_finished(tmp_path):
    folder = tmp_path / "run"
    attack = folder / "camouflages" / "T-Fc-0"
    preset = tmp_path / "tiny.json"
    preset.write_text(json.dumps({**json.loads(TINY.read_text()), "attack_steps": STEPS}))
    left = begin(folder, preset)
    # Of a network of a few steps chance decides whether it finds anything at its own threshold.
    attacks = folder / "logs" / "attack"
    kill_when(start(folder, preset), lambda: any(attacks.glob("*.log")))
    count_everything(folder / "detectors" / "retinanet")

    kill_when(start(folder, preset), lambda: checkpointed_step(attack))
    assert not (attack / "camouflage.json").exists()
    assert not (folder / "tables").exists()
    trained = (folder / "detectors" / "retinanet" / "detector.json").stat().st_mtime_ns
    checkpoint = (attack / "checkpoint.safetensors").stat().st_mtime_ns

    run = start(folder, preset)
    said, _ = run.communicate(timeout=400)
    assert run.returncode == 0, said
    assert "steps were finished before" in said
    assert "report: " in said
    # Nothing finished was done again, and the attack went on where it was.
    assert (folder / "detectors" / "retinanet" / "detector.json").stat().st_mtime_ns == trained
    assert "train retinanet" not in said
    rows = [json.loads(line) for line in (attack / "steps.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(1, 9))
    assert (attack / "previews" / "000001.png").stat().st_mtime_ns < checkpoint

    page = (folder / "tables" / "README.md").read_text()
    for name in ("T-Fc", "R-Fc", "S-O", "C-Fc-seq", "C-Fc-par"):
        assert f"\n| {name} |" in page, name
    rows = json.loads((folder / "results.json").read_text())["rows"]
    assert {row["camouflage"] for row in rows} >= {
        "T-Fc",
        "R-C-Fc@0.4",
        "C-Fc-par@0.4",
    }
    times = json.loads((folder / "timings.json").read_text())
    assert len({(row["stage"], row["name"]) for row in times}) == len(times)
    assert {f"{row['stage']}/{row['name']}" for row in times} == left
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["finished"]
    assert len(environment["commands"]) == 1
    assert not [
        path
        for path in folder.rglob("*")
        if ".partial" in path.name or path.name == "checkpoint.safetensors"
    ]
