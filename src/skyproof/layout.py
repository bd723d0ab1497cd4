"""Where everything lies in a run folder: told here, for those who write it and who read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

CLEARING_RECORD = "clearing.json"
"""In a background set without vehicles: what was removed."""


@dataclass(frozen=True)
class Layout:
    """The places of a run folder.

    Attributes:
        folder: the run folder, as the steps of a plan are to name it.
        world: of a further training, the run folder whose ground, vehicles, scenes, images and
            random draws it shares; None of a run, which has its own.
    """

    folder: Path
    world: Path | None = None

    @property
    def shared(self) -> Layout:
        """The run's own places, of a further training, too."""
        return self if self.world is None else Layout(self.world)

    @property
    def trainings(self) -> Path:
        """The folder of all further trainings of the detectors."""
        return self.folder / "trainings"

    def training(self, number: int) -> Layout:
        """The places of a further training; number 0 is the run itself."""
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
        """What the steps that were begun are made of, as digests."""
        return self.folder / "steps.json"

    @property
    def tiles(self) -> Path:
        """Imagery as it was cut, with its vehicles."""
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
        """What `skyproof precheck` found of a detector."""
        return self.detector(name) / "precheck.json"

    @property
    def camouflages(self) -> Path:
        """The folder of all camouflages, learnt and drawn."""
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
        """Scores of the test scenes in weather: apart, because no scene is in two weathers here."""
        return Layout(self.folder / "weather")

    @property
    def judges(self) -> Path:
        """The folder of detectors that only judge, and of what they judged."""
        return self.folder / "judges"

    def judged(self, table: str) -> Layout:
        """The places of one table of such detectors: `detectors` and `scores` alone."""
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
        """Which detectors are accepted, where that was asked."""
        return self.folder / "verdict.json"

    @property
    def tables(self) -> Path:
        """The paper's tables, as Markdown and CSV."""
        return self.folder / "tables"
