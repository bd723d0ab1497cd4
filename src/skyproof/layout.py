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
        world: run folder whose ground, vehicles, scenes, images and random draws a further training
            shares; None for a run, which has its own.
    """

    folder: Path
    world: Path | None = None

    @property
    def shared(self) -> Layout:
        """The paths of the run itself, also for a further training."""
        return self if self.world is None else Layout(self.world)

    @property
    def trainings(self) -> Path:
        """The folder of all further trainings of the detectors."""
        return self.folder / "trainings"

    def training(self, number: int) -> Layout:
        """The paths of a further training; number 0 is the run itself."""
        return Layout(self.trainings / str(number), self.folder) if number else self

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
        return self.shared.folder / "backgrounds"

    @property
    def fleets(self) -> Path:
        """The four fleets."""
        return self.shared.folder / "fleets"

    def scenes(self, split: str) -> Path:
        """The scene file of a split."""
        return self.shared.folder / "scenes" / f"{split}.jsonl"

    def dataset(self, name: str) -> Path:
        """A rendered dataset: the scenes of a split, perhaps by another renderer."""
        return self.shared.folder / "datasets" / name

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
    def weather(self) -> Layout:
        """Scores of the test scenes in weather, apart, because each scene has one weather here."""
        return Layout(self.folder / "weather")

    @property
    def judges(self) -> Path:
        """The folder of held-out detectors and of their scores."""
        return self.folder / "judges"

    def judged(self, table: str) -> Layout:
        """The paths of one table of held-out detectors: `detectors` and `scores` alone."""
        return Layout(self.judges / table)

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

    @property
    def tables(self) -> Path:
        """The paper's tables, as Markdown and CSV."""
        return self.folder / "tables"
