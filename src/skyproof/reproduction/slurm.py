"""What must be told before Snakemake hands steps to Slurm: is it there, and what works there?"""

import os
import shutil
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

from skyproof.console import say
from skyproof.errors import ConfigurationError, RunFolderError

_PLUGIN = "snakemake_executor_plugin_slurm"
_COMMANDS = ("sbatch", "squeue", "scancel", "sinfo")
_ANSWER_S = 60.0
_POLL_S = 2.0
# Slurm gives a cancelled job 30 s to end, unless a cluster says otherwise.
_PATIENCE_S = 60.0


def check_slurm() -> None:
    """Makes sure that steps can be handed to Slurm from here; ConfigurationError if not."""
    if find_spec("snakemake") is None or find_spec(_PLUGIN) is None:
        raise ConfigurationError(
            "--slurm-jobs needs Snakemake and its plug-in for Slurm; run pip install "
            "'skyproof[slurm]' first."
        )
    missing = [name for name in _COMMANDS if shutil.which(name) is None]
    if missing:
        raise ConfigurationError(
            f"--slurm-jobs needs Slurm, but {', '.join(missing)} cannot be found here; give the "
            "command where jobs of your cluster are submitted, or leave --slurm-jobs out."
        )
    _jobs_of_mine()


def wait_for_earlier_jobs(folder: Path) -> None:
    """Waits a minute for jobs of an earlier call, which write what Snakemake would write again."""
    place = os.path.realpath(folder)
    until = time.monotonic() + _PATIENCE_S
    waited = False
    while jobs := [job for job, where in _jobs_of_mine() if os.path.realpath(where) == place]:
        listed = " ".join(jobs)
        if time.monotonic() > until:
            raise RunFolderError(
                f"Slurm still has jobs of an earlier call that work in {folder}; wait until they "
                f"are done, or end them (scancel {listed}), then give the same command again."
            )
        if not waited:
            say(f"Waiting a minute for jobs of an earlier call: {listed}")
        waited = True
        time.sleep(_POLL_S)


def _jobs_of_mine() -> list[tuple[str, str]]:
    """The user's jobs that wait or run, each with the folder it works in."""
    words = ["squeue", "--me", "--noheader", "--format", "%i %Z"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_ANSWER_S)
    except subprocess.TimeoutExpired:
        why = f"nothing for {_ANSWER_S:.0f} s"
    else:
        if not done.returncode:
            jobs = [line.partition(" ") for line in done.stdout.splitlines() if line.strip()]
            return [(job, folder) for job, _, folder in jobs]
        why = " ".join(done.stderr.split())[-300:].rstrip(".") or f"exit code {done.returncode}"
    raise ConfigurationError(
        f"--slurm-jobs expects a Slurm that answers, but squeue says: {why}; try sinfo, and give "
        "the same command again when it lists nodes."
    )
