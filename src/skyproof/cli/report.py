"""`skyproof report`: a run folder's results as one page and tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say

__all__ = ["Report"]


@dataclass(frozen=True)
class Report:
    """Writes results.json and report.html from all scores of a run folder.

    Where the run has attacks of the paper, its tables are written too: tables/README.md.

    Attributes:
        run_folder: as demo or reproduce leaves it, or a folder with scores/NAME folders that
            score wrote.
    """

    run_folder: Path

    def run(self) -> None:
        """Writes the results, the tables and the page."""
        from skyproof.report.report import write_report

        say(f"Report: {write_report(self.run_folder).resolve()}")
