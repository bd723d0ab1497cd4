"""`skyproof assess`: how robust detectors are on somebody's imagery, and whether they pass."""

from __future__ import annotations

from dataclasses import dataclass

from skyproof.assessment.request import Request


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
