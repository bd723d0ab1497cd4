"""`skyproof reproduce`: the paper's tables and its figure, from nothing."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from tyro.conf import Positional

from skyproof.errors import RunFolderError


@dataclass(frozen=True)
class Reproduce:
    """Runs every attack of the paper with its controls, and writes the paper's tables and figure.

    The results are report.html and tables/README.md. A stopped run resumes with the same command.
    `--dry-run` prints the snakemake command to run the steps on a cluster (docs/cluster.md).

    Attributes:
        preset: quick (slim detectors, two hours of two CPU cores), overnight (all combinations,
            five repeats, longer attacks), paper (full size, one GPU), reference (the shipped
            detectors), or a JSON file like theirs.
        out: run folder to write.
        cores: number of CPU cores; all by default. With 1, the steps run in this process, without
            Snakemake.
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
    device: str = "auto"
    cycles: bool = False
    held_out: tuple[str, ...] = ()
    blender: Path | None = None
    dry_run: bool = False

    def run(self) -> None:
        """Does every step that is not finished."""
        from skyproof.reproduction.reproduce import reproduce

        reproduce(self)


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
