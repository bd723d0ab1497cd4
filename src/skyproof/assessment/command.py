"""`skyproof assess` and `skyproof demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.assessment.request import Request
from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, reference_folder
from skyproof.ranges import Seed


@dataclass(frozen=True)
class Assess(Request):
    """Tests detectors on your imagery with a fixed suite of attacks, and accepts or rejects them.

    It tiles the imagery, clears it of vehicles, freezes thresholds on its labels, prechecks the
    detectors, and measures every attack beside its controls. A stopped run resumes with the same
    command.

    Attributes:
        plan: only estimate the scenes, tiles and time that the request needs.
    """

    plan: bool = False

    def run(self) -> None:
        """Does all steps that are not finished yet, and prints the answer."""
        from skyproof.assessment.assess import plan_assessment, run_assessment

        if self.plan:
            plan_assessment(self)
        else:
            run_assessment(self)


@dataclass(frozen=True)
class Demo:
    """Assesses the two reference detectors on drawn ground with two attacks.

    It takes about five minutes on two CPU cores. A stopped run resumes with the same command.

    Attributes:
        out: run folder to write.
        seed: seed of everything that is drawn.
        device: auto, cpu or cuda.
        cycles: render the test scenes with Blender Cycles, too, also after a finished run.
        blender: Blender 4.5, or a Python with bpy 4.5 (default: of `make blender`, then of the
            PATH).
    """

    out: Path = Path("runs/demo")
    seed: Seed = 0
    device: str = "auto"
    cycles: bool = False
    blender: Path | None = None

    def run(self) -> None:
        """Does all steps that are not finished yet, and prints the answer."""
        from skyproof.assessment.assess import run_assessment
        from skyproof.assessment.suite import DEMO_SUITE

        request = Request(
            tuple(map(reference_folder, REFERENCE_DETECTORS)),
            self.out,
            seed=self.seed,
            device=self.device,
            cycles=self.cycles,
            blender=self.blender,
        )
        run_assessment(request, DEMO_SUITE)
