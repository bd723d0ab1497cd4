"""`skyproof demo`: from nothing to a first robustness report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.detectors.reference_detectors import REFERENCE_DETECTORS, reference_folder
from skyproof.ranges import Seed


@dataclass(frozen=True)
class Demo:
    """Assesses the two detectors that come with skyproof, on drawn ground, by two attacks.

    It takes about five minutes on two CPU cores. Stop it whenever you like and give the same
    command again: it goes on after the last finished step.

    Attributes:
        out: run folder; the report goes there.
        seed: decides everything that is drawn.
        device: auto, cpu or cuda.
        cycles: the test scenes are also judged as Blender Cycles draws them; a finished demo goes
            on with that part alone.
        blender: a Blender 4.5 executable, or a Python that has bpy 4.5, for --cycles; where not
            given, what `make blender` made, then `blender` on the PATH.
    """

    out: Path = Path("runs/demo")
    seed: Seed = 0
    device: str = "auto"
    cycles: bool = False
    blender: Path | None = None

    def run(self) -> None:
        """Does all steps that are not finished yet, and prints the answer."""
        from skyproof.assessment.assess import run_assessment
        from skyproof.assessment.request import Request
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
