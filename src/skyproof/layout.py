"""The paths in a run folder, in one place for its writers and readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

CLEARING_RECORD = "clearing.json"
"""The record of removed vehicles in a cleared background set."""


@dataclass(frozen=True)
class Layout:
    """The paths of a run folder.

    Attributes:
        folder: path of the run folder in the steps of a plan.
    """

    folder: Path

    @property
    def config(self) -> Path:
        """Every setting that decides the results."""
        return self.folder / "config.json"

    @property
    def environment(self) -> Path:
        """Versions, machine, commands, start and end."""
        return self.folder / "environment.json"

    @property
    def timings(self) -> Path:
        """Seconds per step."""
        return self.folder / "timings.json"

    @property
    def steps(self) -> Path:
        """Digests of the inputs of the steps that were begun."""
        return self.folder / "steps.json"

    @property
    def tiles(self) -> Path:
        """Tiles cut from imagery, with their vehicles."""
        return self.folder / "tiles"

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

    @property
    def detectors(self) -> Path:
        """The folder of all detectors."""
        return self.folder / "detectors"

    def detector(self, name: str) -> Path:
        """A detector folder."""
        return self.detectors / name

    def precheck(self, name: str) -> Path:
        """The precheck of a detector."""
        return self.detector(name) / "precheck.json"

    @property
    def camouflages(self) -> Path:
        """The folder of all camouflages, optimised and random."""
        return self.folder / "camouflages"

    def camouflage(self, name: str) -> Path:
        """A camouflage folder."""
        return self.camouflages / name

    @property
    def scores(self) -> Path:
        """The folder of all score folders; the report reads every one."""
        return self.folder / "scores"

    def score(self, name: str) -> Path:
        """A score folder."""
        return self.scores / name

    @property
    def results(self) -> Path:
        """The rows of all scores, merged."""
        return self.folder / "results.json"

    @property
    def report(self) -> Path:
        """The report."""
        return self.folder / "report.html"

    @property
    def verdict(self) -> Path:
        """The accepted and rejected detectors, if there is a requirement."""
        return self.folder / "verdict.json"
