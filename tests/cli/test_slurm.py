"""`skyproof reproduce --slurm-jobs`: refusals, where scripts answer in place of Slurm.

Real jobs are in tests/reproduction/test_slurm.py.
"""

from __future__ import annotations

import json
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from tests.cli.conftest import Skyproof

TINY = Path(__file__).parents[1] / "reproduction" / "tiny.json"
COMMANDS = ("sbatch", "squeue", "scancel", "sinfo")


def slurm_stub(monkeypatch: pytest.MonkeyPatch, folder: Path, queue: str) -> None:
    """Makes Slurm of scripts the only programs there are; `queue` is what squeue does."""
    folder.mkdir(exist_ok=True)
    for name in COMMANDS:
        script = folder / name
        script.write_text(f"#!/bin/sh\n{queue if name == 'squeue' else 'exit 0'}\n")
        script.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(
        "skyproof.reproduction.slurm.find_spec", lambda name: ModuleSpec(name, loader=None)
    )


@pytest.fixture
def asked(tmp_path: Path, skyproof: Skyproof):  # type: ignore[no-untyped-def]
    """Gives the command that every test here gives, with more words."""
    return lambda *more: skyproof(
        "reproduce", "--preset", TINY, "--out", tmp_path / "run", "--slurm-jobs", 2, *more
    )


def test_without_slurm_nothing_begins(asked, tmp_path, monkeypatch):
    slurm_stub(monkeypatch, tmp_path / "bin", "exit 0")
    (tmp_path / "bin" / "sbatch").unlink()
    asked().refused("Slurm", "sbatch", "leave --slurm-jobs out")
    asked("--dry-run").refused("sbatch")
    monkeypatch.setattr(
        "skyproof.reproduction.slurm.find_spec",
        lambda name: ModuleSpec(name, loader=None) if name == "snakemake" else None,
    )
    asked().refused("plug-in", "pip install 'skyproof[slurm]'")
    assert not (tmp_path / "run").exists()


def test_a_slurm_that_does_not_answer(asked, tmp_path, monkeypatch):
    said = "squeue: error: Unable to contact slurm controller (connect failure)"
    slurm_stub(monkeypatch, tmp_path / "bin", f"echo '{said}' >&2; exit 1")
    asked().refused(said, "sinfo")
    monkeypatch.setattr("skyproof.reproduction.slurm._ANSWER_S", 1.0)
    slurm_stub(monkeypatch, tmp_path / "bin", "exec /bin/sleep 5")
    asked().refused("squeue says: nothing for 1 s")
    assert not (tmp_path / "run").exists()


def test_two_places_for_the_steps(asked, tmp_path):
    asked("--cores", 2).refused("--cores", "--slurm-jobs", "one of the two")
    asked("--slurm-jobs", 0).refused("--slurm-jobs", "0")
    assert not (tmp_path / "run").exists()


def test_jobs_of_an_earlier_call_are_waited_for(asked, tmp_path, monkeypatch):
    run = tmp_path / "run"
    (tmp_path / "link").symlink_to(run)
    elsewhere = f"echo '11 {tmp_path}/other run'"
    slurm_stub(
        monkeypatch, tmp_path / "bin", f"{elsewhere}; echo '12 {tmp_path}/link'; echo '13_4 {run}'"
    )
    monkeypatch.setattr("skyproof.reproduction.slurm._PATIENCE_S", 0.2)
    monkeypatch.setattr("skyproof.reproduction.slurm._POLL_S", 0.1)
    answer = asked()
    answer.refused("an earlier call", str(run), "(scancel 12 13_4)")
    assert "Waiting a minute" in answer.out
    assert not (run / "config.json").exists()
    # They end, and what follows is Snakemake's work: here a script that has none.
    slurm_stub(
        monkeypatch,
        tmp_path / "bin",
        f"{elsewhere}; [ -e {tmp_path}/seen ] || echo '12 {run}'; : > {tmp_path}/seen",
    )
    monkeypatch.setattr("skyproof.reproduction.reproduce.snakemake_words", lambda *_: ["/bin/true"])
    answer = asked()
    assert answer.code == 0, answer.err
    assert "2 jobs of Slurm" in answer.out
    assert json.loads((run / "environment.json").read_text())["finished"]


def test_where_the_steps_run_is_not_left_to_a_profile(asked, skyproof, tmp_path, monkeypatch):
    told = tmp_path / "told"
    script = tmp_path / "script"
    script.write_text(f'#!/bin/sh\necho "$@" > {told}\n')
    script.chmod(0o755)
    monkeypatch.setattr("skyproof.reproduction.reproduce.snakemake_words", lambda *_: [str(script)])
    skyproof("reproduce", "--preset", TINY, "--out", tmp_path / "here", "--cores", 2)
    assert "--executor local --cores 2" in told.read_text()
    slurm_stub(monkeypatch, tmp_path / "bin", "exit 0")
    asked()
    assert "--executor slurm --jobs 2" in told.read_text()
    assert "--cores" not in told.read_text()
