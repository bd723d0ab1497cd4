"""`skyproof assess`: how robust detectors are on somebody's imagery, and whether they pass."""

from __future__ import annotations

from dataclasses import dataclass

from skyproof.assessment.request import Request


@dataclass(frozen=True)
class Assess(Request):
    """Puts detectors to the suite of attacks on your imagery, and says whether they pass.

    Imagery is tiled and cleared of its vehicles, thresholds are frozen on its labels, the detectors
    checked, every attack of the suite made against them and measured beside its controls. Stop it
    whenever you like and give the same command again: it goes on after the last finished step.

    Attributes:
        plan: only say how many test scenes the request needs and has, and how long it takes.
    """

    plan: bool = False

    def run(self) -> None:
        """Does all steps that are not finished yet, and prints the answer."""
        from skyproof.assessment.assess import plan_assessment, run_assessment

        if self.plan:
            plan_assessment(self)
        else:
            run_assessment(self)
