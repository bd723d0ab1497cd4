"""The paths in a run folder, in one place for its writers and readers."""

from dataclasses import dataclass
from pathlib import Path

CLEARING_RECORD = "clearing.json"
"""The record of removed vehicles in a cleared background set."""


class RunPath:
    """A path in a run folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, layout: "Layout", kind: "type[Layout]") -> Path:
        return layout.folder / self._name


@dataclass(frozen=True)
class Layout:
    """The paths of a run folder."""

    folder: Path

    config = RunPath("config.json")  # every setting that decides the results
    environment = RunPath("environment.json")  # versions, machine, commands, start and end
    timings = RunPath("timings.json")  # seconds per step
    steps = RunPath("steps.json")  # digests of the inputs of the steps that were begun
    tiles = RunPath("tiles")  # cut from imagery, with their vehicles
    backgrounds = RunPath("backgrounds")
    fleets = RunPath("fleets")
    detectors = RunPath("detectors")
    camouflages = RunPath("camouflages")  # optimised and random
    scores = RunPath("scores")  # score folders, all of which the report reads
    results = RunPath("results.json")  # the rows of all scores, merged
    report = RunPath("report.html")
    verdict = RunPath("verdict.json")  # accepted and rejected detectors, with a requirement

    def scenes(self, split: str) -> Path:
        """The scene file of a split."""
        return self.folder / "scenes" / f"{split}.jsonl"

    def dataset(self, name: str) -> Path:
        """A rendered dataset: the scenes of a split, perhaps by another renderer."""
        return self.folder / "datasets" / name

    def detector(self, name: str) -> Path:
        return self.detectors / name

    def precheck(self, name: str) -> Path:
        return self.detector(name) / "precheck.json"

    def camouflage(self, name: str) -> Path:
        return self.camouflages / name

    def score(self, name: str) -> Path:
        return self.scores / name
