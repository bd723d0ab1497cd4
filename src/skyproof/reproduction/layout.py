"""The further paths in the run folder of a reproduction."""

from skyproof.layout import Layout, RunPath


class PaperLayout(Layout):
    """The paths of a reproduction's run folder."""

    held_out = RunPath("judges")  # held-out detectors and their scores
    looks = RunPath("looks")  # what camouflages look like
    features = RunPath("features.parquet")  # the detectors' features
    tables = RunPath("tables")  # the paper's tables, as Markdown and CSV

    @property
    def weather(self) -> Layout:
        """Scores of the test scenes in weather, apart, because each scene has one weather here."""
        return Layout(self.folder / "weather")

    def table(self, name: str) -> Layout:
        """The paths of one table of held-out detectors: `detectors` and `scores` alone."""
        return Layout(self.held_out / name)
