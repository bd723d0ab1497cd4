"""A run's results by attack, each at its best magnitude, beside the paper's numbers."""

from functools import cached_property

from skyproof.camouflage.name import CamouflageName
from skyproof.reproduction.curves import PracticalityCurve, practicality_curves
from skyproof.reproduction.layout import PaperLayout
from skyproof.reproduction.paper_results import PAPER_RESULTS
from skyproof.reproduction.stored import (
    Features,
    Looks,
    Practicality,
    read_features,
    read_looks,
    read_practicality,
)
from skyproof.results.result import MAIN_MATCH, Result
from skyproof.results.results import CYCLES, RENDERER, Results

_FEWEST = 3


class Reproduction:
    """Results of a run, with the curves of EASR against practicality for the paper's tables."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.detectors = results.detectors
        self.cycles = CYCLES in results.renderers
        # Without repeats.
        self.names = [str(name) for name in results.names]
        self.layout = PaperLayout(results.folder)
        scores = sorted(self.layout.held_out.glob("[!.]*/scores/*/score.json"))
        tables = dict.fromkeys(path.parents[2] for path in scores)
        self.held_out = {table.name: Results.open(table) for table in tables}

    @property
    def comparable(self) -> bool:
        """Whether enough of the paper's attacks were scored to set them beside its tables."""
        learnt = [name for name in self.results.names if not name.random]
        ours = {*map(str, learnt), *(name.family for name in learnt)}
        return RENDERER in self.results.renderers and len(ours & set(PAPER_RESULTS)) >= _FEWEST

    def row(
        self, name: str, detector: str | None = None, *, renderer: str = RENDERER
    ) -> Result | None:
        """Finds a camouflage's row, of the mean over detectors or of one; None if not scored."""
        return self.results.row(CamouflageName.read(name), detector, renderer=renderer)

    def original_ap(self, detector: str, renderer: str = RENDERER) -> float | None:
        """Finds a detector's AP without camouflage, the same in all rows, in percent."""
        wanted = (detector, renderer, MAIN_MATCH)
        for row in self.results.rows:
            if (row.detector, row.renderer, row.match) == wanted:
                return 100 * row.ap_original
        return None

    @cached_property
    def curves(self) -> dict[str, PracticalityCurve]:
        """Returns EASR against practicality of each attack with a shape ("S-O", "C-Fc-seq")."""
        return practicality_curves(self.results.counts)

    @cached_property
    def best(self) -> dict[str, str]:
        """Returns the camouflage at the PM* of each attack with a shape, by attack."""
        return {
            family: point_name(family, curve.best.perturbation_magnitude)
            for family, curve in self.curves.items()
        }

    @cached_property
    def looks(self) -> Looks | None:
        """What textures look like; None where it was not measured."""
        return read_looks(self.layout.looks)

    @cached_property
    def practicality(self) -> dict[CamouflageName, Practicality]:
        """The practicality of finished attacks; empty where it was not measured."""
        return read_practicality(self.layout.looks)

    @cached_property
    def features(self) -> list[Features]:
        """Returns the stored features of the detectors; empty if there are none."""
        path = self.layout.features
        return read_features(path) if path.exists() else []


def point_name(family: str, magnitude: float) -> str:
    """What stands at a point of a curve: at PM 0 the texture, or "S-O@0", which is never scored."""
    if magnitude > 0 or family == "S-O":
        return f"{family}@{magnitude:g}"
    return "T-" + family.split("-")[1]
