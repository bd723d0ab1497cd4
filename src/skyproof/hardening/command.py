"""`skyproof harden` and its options."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from skyproof.ranges import Count, Seed


@dataclass(frozen=True)
class Harden:
    """Trains the detector of an assessment further, so that it withstands attacks.

    It is shown vehicles in camouflages that are optimised against it as it learns, on the attack
    tiles of the assessment with their labels, never on those of its test. For a detector that
    cannot be trained here, it renders images to add to the detector's own training. A stopped run
    resumes with the same command.

    Attributes:
        run_folder: finished run of `skyproof assess` with one detector.
        out: run folder to write: the hardened detector in its `detectors`, or images in its
            `datasets`.
        data: further dataset folders of labelled photographs, apart from those of the test.
        steps: number of optimiser steps.
        seed: seed of everything that is drawn.
    """

    run_folder: Positional[Path]
    out: Path
    data: tuple[Path, ...] = ()
    steps: Count = 1500
    seed: Seed = 0

    def run(self) -> None:
        """Runs all unfinished steps, and says what to do next."""
        from skyproof.hardening.harden import harden_run

        harden_run(self)
