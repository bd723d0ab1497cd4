"""What repeats of a camouflage are to statistics: seeds of an attack, or draws of a control."""

from skyproof.camouflage.name import CamouflageName
from skyproof.results.statistics.repeats import DRAWS, SEEDS, Repeat


def repeat_of(camouflage: str) -> Repeat:
    """Says which repeat of what a camouflage is, by its name: "R-U-1" is a draw of "R-U"."""
    name = CamouflageName.read(camouflage)
    return Repeat(str(name.pooled), name.repeat, DRAWS if name.random else SEEDS)
