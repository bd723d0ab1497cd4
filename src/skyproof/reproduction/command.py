"""`skyproof reproduce`: the paper's tables and its figure, from nothing."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta
from tyro.conf import Positional

from skyproof.console import say
from skyproof.detectors.reference_detectors import reference_folder
from skyproof.errors import ConfigurationError, RunFolderError

if TYPE_CHECKING:
    from skyproof.assessment.run import Run
    from skyproof.files import Hold
    from skyproof.reproduction.held_out_detectors import HeldOutDetector
    from skyproof.reproduction.plan import Plan
    from skyproof.reproduction.preset import Preset


@dataclass(frozen=True)
class Reproduce:
    """Runs every attack of the paper with its controls, and writes the paper's tables and figure.

    The results are report.html and tables/README.md. A stopped run resumes with the same command.
    `--slurm-jobs` uses a cluster with Slurm, and `--dry-run` prints the snakemake command for
    another one (docs/cluster.md).

    Attributes:
        preset: quick (slim detectors, two CPU cores), paper (full size, one GPU), reference (the
            shipped detectors), trainings (three trainings of each detector), or a JSON file like
            theirs.
        out: run folder to write.
        cores: number of CPU cores; all by default. With 1, the steps run in this process, without
            Snakemake.
        slurm_jobs: number of simultaneous Slurm jobs that run the steps instead. SNAKEMAKE_PROFILE
            names a profile with account and partition.
        device: auto, cpu or cuda.
        cycles: render the test scenes with Blender Cycles, too (the paper's "Blender" column), also
            after a finished run.
        held_out: further held-out detectors, [TABLE=]FOLDER, also after a finished run. Detectors
            of one TABLE have the same training images, and a mean.
        blender: Blender 4.5, or a Python with bpy 4.5 (default: of `make blender`, then of the
            PATH).
        dry_run: only check the request and list its steps.
    """

    preset: str = "quick"
    out: Path = Path("runs/reproduce")
    cores: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    slurm_jobs: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    device: str = "auto"
    cycles: bool = False
    held_out: tuple[str, ...] = ()
    blender: Path | None = None
    dry_run: bool = False

    def run(self) -> None:
        """Does every step that is not finished."""
        from skyproof.assessment.run import Run
        from skyproof.device import choose_device
        from skyproof.reproduction.held_out_detectors import (
            new_tables,
            read_held_out,
            store_reference_detectors,
            store_tables,
            stored_tables,
        )
        from skyproof.reproduction.layout import PaperLayout
        from skyproof.reproduction.plan import reproduction_plan
        from skyproof.reproduction.preset import read_preset
        from skyproof.reproduction.slurm import wait_for_earlier_jobs

        name, path, values, preset = read_preset(self.preset)
        count = self._side_by_side()
        choose_device(self.device)
        _refuse_unbuildable(preset)
        blender = self._blender()
        layout = PaperLayout(self.out)
        given = read_held_out(self.held_out)
        added = new_tables(layout, preset, given)
        names = {table: tuple(sorted(each.name for each in its)) for table, its in added.items()}
        tables = dict(sorted((stored_tables(layout) | names).items()))
        plan = reproduction_plan(
            preset, self.out, device=self.device, blender=blender, held_out=tables
        )
        run = Run(self.out, {"preset": name, **values}, plan.steps)
        if self.dry_run:
            self._say_how(path, preset, plan, blender, added)
            return
        if self.slurm_jobs is not None:
            wait_for_earlier_jobs(self.out)
        with run.begun(self.device) as hold:
            store_reference_detectors(layout, preset)
            store_tables(layout, new_tables(layout, preset, given))
            where = "cores" if self.slurm_jobs is None else "jobs of Slurm"
            say(
                f"skyproof reproduce, preset {name}: {plan.in_words}; {count} {where}, "
                f"run folder {self.out}"
            )
            if count == 1 and self.slurm_jobs is None:
                run.do()
            else:
                self._run_snakemake(preset, plan, run, hold, blender, count)
        page = layout.tables / "README.md"
        # A run without textures has none of the paper's tables.
        if page.exists():
            say(f"Tables: {page.resolve()}")
        say(f"Report: {layout.report.resolve()}")

    def _run_snakemake(
        self, preset: Preset, plan: Plan, run: Run, hold: Hold, blender: Path | None, count: int
    ) -> None:
        from skyproof.reproduction.slurm import slurm_words
        from skyproof.reproduction.snakemake import run_side_by_side, snakemake_words

        command = snakemake_words(self.out, blender, self.device)
        # Marks left by a kill must not stop the next try; our own lock keeps a second run away.
        command += ["--rerun-incomplete", "--nolock", "--scheduler", "greedy"]
        # A user's profile does not decide where the steps run.
        if self.slurm_jobs is not None:
            command += slurm_words(count)
        else:
            command += ["--executor", "local", "--cores", str(count)]
            command += ["--resources", "gpu=1"] if preset.resources.gpu else []
        run_side_by_side(plan, run, command, count, hold)

    def _side_by_side(self) -> int:
        """How many steps run at once, on this machine or in Slurm.

        Raises:
            ConfigurationError: Snakemake or Slurm is missing, or both options are given.
        """
        from skyproof.reproduction.slurm import check_slurm

        if self.slurm_jobs is not None:
            if self.cores is not None:
                raise ConfigurationError(
                    "--cores is for the steps on this machine, --slurm-jobs for those on a "
                    "cluster; give one of the two."
                )
            check_slurm()
            return self.slurm_jobs
        cores = len(os.sched_getaffinity(0)) if self.cores is None else self.cores
        if (cores > 1 or self.dry_run) and find_spec("snakemake") is None:
            raise ConfigurationError(
                "skyproof reproduce on several cores needs Snakemake; run pip install "
                "'skyproof[reproduce]' first, or give --cores 1."
            )
        return cores

    def _blender(self) -> Path | None:
        """The Blender of the Cycles column.

        Raises:
            ConfigurationError: there is no usable Blender, or it is given without --cycles.
        """
        from skyproof.cycles.blender import find_blender

        if not self.cycles:
            if self.blender is not None:
                raise ConfigurationError(
                    "--blender is for the Cycles column; give --cycles too, or leave it out."
                )
            return None
        # Not resolved: the Python of a virtual environment is a link, and loses its packages when
        # followed.
        return find_blender(self.blender).path.absolute()

    def _say_how(
        self,
        path: Path,
        preset: Preset,
        plan: Plan,
        blender: Path | None,
        added: Mapping[str, Sequence[HeldOutDetector]],
    ) -> None:
        """Prints the steps, and the commands for them."""
        from skyproof.reproduction.layout import PaperLayout
        from skyproof.reproduction.slurm import slurm_words
        from skyproof.reproduction.snakemake import snakemake_words

        say(f"Steps: {plan.in_words}.")
        say("By hand, or with options for a cluster's executor:")
        own = PaperLayout(self.out)
        copies = [
            (each.folder, own.table(table).detector(each.name))
            for table, detectors in added.items()
            for each in detectors
        ]
        if not own.config.exists():
            copies += [(reference_folder(name), own.detector(name)) for name in preset.reference]
        copies.append((path, own.config))
        for parent in dict.fromkeys(copy.parent for _, copy in copies):
            say("  " + shlex.join(["mkdir", "-p", str(parent)]))
        for source, copy in copies:
            say("  " + shlex.join(["cp", "-r", str(source), str(copy)]))
        where = ["--cores", "2"] if self.slurm_jobs is None else slurm_words(self.slurm_jobs)
        say("  " + shlex.join([*snakemake_words(self.out, blender), *where]))


def _refuse_unbuildable(preset: Preset) -> None:
    """Shows a detector whose library is missing before the ground is drawn."""
    import torch

    from skyproof.detectors.build import build_detector

    for name in preset.detectors:
        build_detector(name, preset.size, generator=torch.Generator())


@dataclass(frozen=True)
class OneStep:
    """Does one step of the reproduction in the current folder, as its `config.json` has it.

    Attributes:
        name: kind and name of the step, such as attack/T-U-0; logs/ is ordered by them.
        device: auto, cpu or cuda.
        blender: Blender of the Cycles column; without it that column has no steps.
    """

    name: Positional[str]
    device: str = "auto"
    blender: Path | None = None

    def run(self) -> None:
        """Does the step, whether or not it is finished."""
        from skyproof.reproduction.plan import plan_of_run

        steps = plan_of_run(self.device, self.blender).steps
        step = next((step for step in steps if step.id == self.name), None)
        if step is None:
            raise RunFolderError(
                f"The run has no step {self.name!r}; give one of its {len(steps)}, such as "
                f"{steps[0].id}."
            )
        step.work()
