"""`skyproof reproduce`: the paper's tables and its figure, from nothing."""

from __future__ import annotations

import os
import shlex
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.cli.console import say
from skyproof.errors import ConfigurationError
from skyproof.plans.plan import Plan

__all__ = ["Reproduce"]


@dataclass(frozen=True)
class Reproduce:
    """Runs every attack of the paper with random controls, and compares the numbers.

    It ends in report.html and in tables/README.md: both tables and the figure of EASR against
    practicality. Stop it whenever you like and give the same command again: finished steps are
    kept, training and attacks go on from their last checkpoint.

    On a cluster: give --dry-run, which prints the plain snakemake command; add its options for your
    executor, such as --executor slurm --jobs 50. Every step says what memory, time and GPU it asks
    for.

    Attributes:
        preset: quick (slim detectors, for 2 CPU cores), paper (full size, for one GPU), reference
            (training and check of the detectors that skyproof brings along), or a JSON
            file like theirs.
        out: run folder.
        cores: CPU cores to use; all where not given. With 1, the steps are done one after the other
            in this process, without Snakemake.
        device: auto, cpu or cuda.
        cycles: also score finished attacks and random controls as Blender's path tracer Cycles
            draws them, the paper's "Blender" column. A finished run may be given again with it:
            only that column is added then.
        blender: for --cycles: a Blender 4.5 executable, or a Python that has bpy 4.5; where not
            given, what `make blender` made, then `blender` on the PATH.
        dry_run: only check, and say what would be done and how.
    """

    preset: str = "quick"
    out: Path = Path("runs/reproduce")
    cores: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    device: str = "auto"
    cycles: bool = False
    blender: Path | None = None
    dry_run: bool = False

    def run(self) -> None:
        """Runs what is not finished yet."""
        from skyproof.cli.device import choose_device
        from skyproof.files import alone
        from skyproof.plans.demo import check_detectors
        from skyproof.plans.preset import Preset, read_preset
        from skyproof.plans.reproduction import reproduction_plan
        from skyproof.plans.run_folder import RunFolder
        from skyproof.plans.serial import run_serially
        from skyproof.plans.snakemake import run_side_by_side, snakemake_words

        name, path, values, preset = read_preset(self.preset)
        cores = len(os.sched_getaffinity(0)) if self.cores is None else self.cores
        if (cores > 1 or self.dry_run) and find_spec("snakemake") is None:
            raise ConfigurationError(
                "skyproof reproduce on several cores needs Snakemake; run pip install "
                "'skyproof[reproduce]' first, or give --cores 1."
            )
        choose_device(self.device)
        check_detectors(preset.detectors, preset.size)
        more = self._cycles()
        blender = Path(more["blender"]) if more else None

        def plan_of(config: Mapping[str, Any]) -> Plan:
            return reproduction_plan(
                Preset.parse(config),
                self.out,
                device=self.device,
                cycles=self.cycles,
                blender=blender,
            )

        config = {"preset": name, **values}
        plan = plan_of(config)
        run = RunFolder(self.out, config, plan, plan_of)
        if self.dry_run:
            self._check(path, plan, more)
            return
        with alone(self.out) as hold:
            # Somebody else may have begun meanwhile.
            run = RunFolder(self.out, config, plan, plan_of)
            run.start(self.device)
            say(
                f"skyproof reproduce, preset {name}: {_listed(plan)}; {cores} cores, "
                f"run folder {self.out}"
            )
            if cores == 1:
                run_serially(plan, run)
            else:
                more = {"device": self.device, **more}
                command = snakemake_words(self.out, self.out / "config.json", more)
                # Marks left by a kill must not stop the next try; our own lock keeps a second run
                # away.
                command += ["--cores", str(cores), "--rerun-incomplete", "--nolock"]
                command += ["--scheduler", "greedy"]
                if preset.resources.gpu:
                    command += ["--resources", "gpu=1"]
                run_side_by_side(plan, run, command, cores, hold)
            run.finish()
        say(f"Tables: {(self.out / 'tables' / 'README.md').resolve()}")
        say(f"Report: {(self.out / 'report.html').resolve()}")

    def _cycles(self) -> dict[str, str]:
        """What the workflow is told of the Cycles column, which is no setting of the run folder.

        Raises:
            ConfigurationError: there is no usable Blender, or it is given for nothing.
        """
        from skyproof.cycles.blender import find_blender

        if not self.cycles:
            if self.blender is not None:
                raise ConfigurationError(
                    "--blender is for the Cycles column; give --cycles too, or leave it out."
                )
            return {}
        # Not resolved: the Python of a virtual environment is a link, and loses its packages when
        # followed.
        return {"cycles": "1", "blender": str(find_blender(self.blender).path.absolute())}

    def _check(self, path: Path, plan: Plan, more: Mapping[str, str]) -> None:
        from skyproof.plans.snakemake import snakemake_words

        with tempfile.TemporaryDirectory() as empty:
            place = self.out if self.out.exists() else Path(empty)
            words = snakemake_words(place, path, more)
            words += ["--cores", "1", "--dry-run", "--nolock", "--quiet", "all"]
            done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            said = " ".join(done.stderr.split())[-400:]
            raise ConfigurationError(
                f"Snakemake refuses this plan ({said.rstrip('.')}); mend what it names."
            )
        say(f"Steps: {_listed(plan)}.")
        say("By hand, or with options for a cluster's executor:")
        say("  " + shlex.join(snakemake_words(self.out, path, more)) + " --cores 2")


def _listed(plan: Plan) -> str:
    counts = ", ".join(f"{kind} {count}" for kind, count in plan.counts.items())
    return f"{len(plan.steps)} steps ({counts})"
