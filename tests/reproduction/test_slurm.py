"""A tiny reproduction whose steps are jobs of Slurm: stopped twice, and given again.

`tools/one_node_slurm.sh` makes a machine a cluster that will do.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.files import alone
from skyproof.reproduction.plan import reproduction_plan
from skyproof.reproduction.preset import Preset
from skyproof.reproduction.slurm import check_slurm
from tests.barely_trained import count_everything
from tests.reproduction.test_end_to_end import checkpointed_step, kill

pytestmark = pytest.mark.slurm

TINY = json.loads(Path(__file__).with_name("tiny.json").read_text())
# An attack that is stopped must not end by itself meanwhile.
STEPS = 60
# The plug-in asks every 40 s how jobs are, unless told otherwise, and throws logs away.
PROFILE = """
slurm-init-seconds-before-status-checks: 2
slurm-keep-successful-logs: true
default-resources:
  mem_mb: 1000
  runtime: 30
"""
REMEDY = "make one with tools/one_node_slurm.sh"


def answer(*words):
    return subprocess.run(words, capture_output=True, text=True, timeout=60).stdout


@pytest.fixture(scope="module", autouse=True)
def slurm():
    """Skips, with the reason, where jobs cannot be run."""
    try:
        check_slurm()
    except ConfigurationError as error:
        pytest.skip(f"{error} {REMEDY}")
    nodes = answer("sinfo", "--noheader", "--format", "%T").split()
    if not {"idle", "mixed", "allocated"} & set(nodes):
        pytest.skip(f"no node of Slurm works, sinfo says {nodes}; {REMEDY}")
    if shutil.which("sacct") is None:
        pytest.skip(f"Slurm does not account for jobs; {REMEDY}")


@pytest.fixture
def start(tmp_path):
    """Gives the command to start, with a preset and a profile beside the run folder.

    Whatever still runs at the end is ended, and its jobs with it.
    """
    runs = []
    preset = tmp_path / "preset.json"
    longer = {**TINY["attack_steps"], "texture": STEPS}
    preset.write_text(json.dumps({**TINY, "attack_steps": longer}))
    profile = tmp_path / "profile"
    profile.mkdir()
    words = ["reproduce", "--preset", preset, "--out", tmp_path / "run", "--slurm-jobs", "2"]

    def started(changes=""):
        (profile / "config.yaml").write_text(PROFILE + changes)
        run = subprocess.Popen(
            [sys.executable, "-m", "skyproof", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "SNAKEMAKE_PROFILE": str(profile)},
        )
        runs.append(run)
        return run

    yield started
    for run in runs:
        if run.poll() is None:
            kill(run)
    if left := waiting_or_running(tmp_path / "run"):
        answer("scancel", *left)


def waiting_or_running(folder):
    lines = answer("squeue", "--me", "--noheader", "--format", "%i %Z").splitlines()
    return {line.split()[0] for line in lines if line.endswith(f" {folder}")}


def nobody_works_in(folder):
    """Whether also what watched the jobs has ended."""
    try:
        with alone(folder):
            return True
    except RunFolderError:
        return False


def states(folder):
    """How Slurm itself says that the jobs of a folder ended, by their numbers."""
    words = ["sacct", "--allocations", "--noheader", "--parsable2", "--starttime", "now-1days"]
    lines = answer(*words, "--format", "JobID,State,WorkDir").splitlines()
    rows = [line.split("|") for line in lines]
    return {job: state for job, state, where in rows if where == str(folder)}


def numbers_by_rule(folder):
    """The jobs that had a step's rule; Slurm writes a log for each."""
    logs = (folder / ".snakemake" / "slurm_logs").glob("rule_*/*.log")
    found = {}
    for log in logs:
        found.setdefault(log.parent.name.removeprefix("rule_"), set()).add(log.stem)
    return found


def wait_for(reached, run=None):
    """Waits, at most for a quarter of an hour and while a run goes on."""
    end = time.monotonic() + 900
    while not reached():
        assert run is None or run.poll() is None, run.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.02)


def test_steps_are_jobs_and_go_on_after_a_power_cut_and_a_kill(start, tmp_path):
    folder = tmp_path / "run"
    detector = folder / "detectors" / "retinanet"
    attack = folder / "camouflages" / "T-Fc-0"

    # The machine that submits loses power: nobody cancels what runs.
    run = start()
    wait_for((detector / "detector.json").exists, run)
    kill(run)
    assert waiting_or_running(folder)
    # Of a network of a few steps chance decides whether it finds anything at its own threshold.
    count_everything(detector)

    # The command alone is killed: what watches it cancels its jobs.
    run = start()
    wait_for(lambda: checkpointed_step(attack), run)
    run.kill()
    run.communicate()
    wait_for(lambda: not waiting_or_running(folder) and nobody_works_in(folder))
    assert [state for state in states(folder).values() if state.startswith("CANCELLED")]
    assert not (attack / "camouflage.json").exists()
    trained = (detector / "detector.json").stat().st_mtime_ns
    checkpoint = (attack / "checkpoint.safetensors").stat().st_mtime_ns

    run = start()
    said, _ = run.communicate(timeout=1800)
    assert run.returncode == 0, said
    assert "2 jobs of Slurm" in said
    assert "steps were finished before" in said
    # Nothing finished was done again, and the attack went on where it was.
    assert (detector / "detector.json").stat().st_mtime_ns == trained
    rows = [json.loads(line) for line in (attack / "steps.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(1, STEPS + 1))
    assert (attack / "previews" / "000001.png").stat().st_mtime_ns < checkpoint
    assert "| T-Fc |" in (folder / "tables" / "README.md").read_text()
    steps = reproduction_plan(Preset.parse(TINY), Path()).steps
    assert len(json.loads((folder / "timings.json").read_text())) == len(steps)

    # Every step was done by a job of Slurm, as Slurm tells it, and not on the machine that asked.
    ended = states(folder)
    done = {
        rule
        for rule, jobs in numbers_by_rule(folder).items()
        if any(ended.get(job) == "COMPLETED" for job in jobs)
    }
    assert done == {f"{step.kind}_{number}" for number, step in enumerate(steps)}


def test_a_job_that_slurm_refuses_is_named_with_the_reason(start):
    run = start("  slurm_partition: nowhere\n")
    said, _ = run.communicate(timeout=300)
    assert run.returncode == 2
    assert said.splitlines()[-1].startswith("skyproof: A step failed (sbatch: error: ")
    assert "Invalid partition name specified" in said
    assert "snakemake.log" in said
