"""`skyproof tables`: a reproduction's numbers beside the paper's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.report.reproduction import write_reproduction

__all__ = ["Tables"]


@dataclass(frozen=True)
class Tables:
    """Writes the paper's tables and its figure from a reproduction's scores; reproduce does this at its end.

    Attributes:
        run_folder: as reproduce leaves it.
    """

    run_folder: Path

    def run(self) -> None:
        """Writes tables/ and results.json."""
        say(f"Tables: {write_reproduction(self.run_folder).resolve()}")
