"""`skyproof report`: a run folder's results as one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.console import say
from skyproof.ranges import Fraction, Risk


@dataclass(frozen=True)
class Report:
    """Writes results.json and report.html from all scores of a run folder.

    Attributes:
        run_folder: as assess or demo leaves it, or a folder with scores/NAME folders that
            score wrote.
        accept: share of found vehicles that a detector may lose to the worst attack; with `reject`,
            the report says which detectors are accepted, and verdict.json is written, too.
        reject: the share lost from which on it is refused.
        producer_risk: chance at most that a detector which loses `accept` is rejected.
        consumer_risk: chance at most that one which loses `reject` is accepted.
    """

    run_folder: Path
    accept: Fraction | None = None
    reject: Fraction | None = None
    producer_risk: Risk = 0.05
    consumer_risk: Risk = 0.05

    def run(self) -> None:
        """Writes the results and the page."""
        from skyproof.report.report import write_report
        from skyproof.results.statistics.acceptance import requirement_of

        requirement = requirement_of(
            self.accept, self.reject, self.producer_risk, self.consumer_risk
        )
        say(f"Report: {write_report(self.run_folder, requirement).resolve()}")
