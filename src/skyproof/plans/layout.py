"""Where everything lies in a run folder, the same for every plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Layout"]


@dataclass(frozen=True)
class Layout:
    """The places of a run folder.

    Attributes:
        folder: the run folder, as the steps of a plan are to name it.
    """

    folder: Path

    @property
    def backgrounds(self) -> Path:
        """The background set."""
        return self.folder / "backgrounds"

    @property
    def fleets(self) -> Path:
        """The four fleets."""
        return self.folder / "fleets"

    def scenes(self, split: str) -> Path:
        """The scene file of a split."""
        return self.folder / "scenes" / f"{split}.jsonl"

    def dataset(self, name: str) -> Path:
        """A rendered dataset: the scenes of a split, perhaps by another renderer."""
        return self.folder / "datasets" / name

    def detector(self, name: str) -> Path:
        """A detector folder."""
        return self.folder / "detectors" / name

    @property
    def camouflages(self) -> Path:
        """The folder of all camouflages, learnt and drawn."""
        return self.folder / "camouflages"

    def camouflage(self, name: str) -> Path:
        """A camouflage folder."""
        return self.camouflages / name

    def scores(self, name: str) -> Path:
        """A score folder; the report reads all of them."""
        return self.folder / "scores" / name

    @property
    def results(self) -> Path:
        """The rows of all scores, merged."""
        return self.folder / "results.json"

    @property
    def report(self) -> Path:
        """The report."""
        return self.folder / "report.html"
