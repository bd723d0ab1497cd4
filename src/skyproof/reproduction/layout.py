"""The further paths in the run folder of a reproduction."""

from pathlib import Path

from skyproof.layout import Layout


class PaperLayout(Layout):
    """The paths of a reproduction's run folder."""

    @property
    def trainings(self) -> Path:
        """The folder of all further trainings of the detectors."""
        return self.folder / "trainings"

    def training(self, number: int) -> Layout:
        """The paths of a further training's detectors, camouflages and scores; 0 is the run."""
        return Layout(self.trainings / str(number)) if number else self

    @property
    def weather(self) -> Layout:
        """Scores of the test scenes in weather, apart, because each scene has one weather here."""
        return Layout(self.folder / "weather")

    @property
    def held_out(self) -> Path:
        """The folder of held-out detectors and of their scores."""
        return self.folder / "judges"

    def table(self, name: str) -> Layout:
        """The paths of one table of held-out detectors: `detectors` and `scores` alone."""
        return Layout(self.held_out / name)

    @property
    def looks(self) -> Path:
        """What camouflages look like."""
        return self.folder / "looks"

    @property
    def features(self) -> Path:
        """The detectors' features."""
        return self.folder / "features.parquet"

    @property
    def tables(self) -> Path:
        """The paper's tables, as Markdown and CSV."""
        return self.folder / "tables"
