"""`skyproof report`: a run folder's results as one page."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from skyproof.console import say
from skyproof.ranges import Fraction, Risk


@dataclass(frozen=True)
class Report:
    """Writes results.json and report.html of a run folder again, from all of its scores.

    Attributes:
        run_folder: folder that assess or demo wrote, or a folder with scores in `scores/`.
        accept: share of found vehicles that the worst attack may hide. With `--reject` the report
            accepts or rejects each detector, and writes verdict.json.
        reject: share of hidden vehicles from which a detector is rejected.
        producer_risk: largest chance that a detector at `--accept` is rejected.
        consumer_risk: largest chance that a detector at `--reject` is accepted.
    """

    run_folder: Positional[Path]
    accept: Fraction | None = None
    reject: Fraction | None = None
    producer_risk: Risk = 0.05
    consumer_risk: Risk = 0.05

    def run(self) -> None:
        from skyproof.report.report import write_report
        from skyproof.results.statistics.acceptance import requirement_of

        requirement = requirement_of(
            self.accept, self.reject, self.producer_risk, self.consumer_risk
        )
        say(f"Report: {write_report(self.run_folder, requirement).resolve()}")
